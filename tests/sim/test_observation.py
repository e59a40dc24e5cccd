"""Parts of a rollout have the same rows as the whole."""

import dataclasses

import numpy as np
import pytest
from identical import assert_identical

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Rollout, RunInfo, Runner


@pytest.fixture(scope="module")
def rollout(panda):
    params = panda.params(kp=np.linspace(30.0, 50.0, 3)[:, None])
    with Runner(panda, 3, workers=0, params=params, substeps=2) as runner:
        return runner.rollout(np.tile(panda.settings.target, (6, 1)))


def test_some_envs_keep_their_rows_and_their_params(rollout):
    part = rollout.for_envs([2, 0])
    assert part.num_envs == 2
    np.testing.assert_array_equal(part.qpos, rollout.qpos[:, [2, 0]])
    np.testing.assert_array_equal(part.info.start, rollout.info.start[[2, 0]])
    np.testing.assert_array_equal(part.info.params.kp[:, 0], [50.0, 30.0])


def test_successive_parts_join_to_the_whole(rollout):
    parts = [rollout.for_ticks(slice(0, 2)), rollout.for_ticks(slice(2, None))]
    whole = Rollout.join(parts)
    assert_identical(whole, rollout)
    assert (whole.tick, whole.info.robot) == (rollout.tick, "panda")


def test_the_tick_does_not_depend_on_the_time_of_the_start(panda):
    with Runner(panda, 1, workers=0, substeps=3) as runner:
        first = runner.rollout(np.tile(panda.start, (2, 1)))
        runner.rollout(np.tile(panda.start, (50, 1)))
        later = runner.rollout(np.tile(panda.start, (2, 1)))
    assert first.tick == later.tick == 3 / 2000
    assert later.for_ticks(slice(None, None, 2)).tick == 2 * later.tick


def test_representations_are_one_line(rollout):
    for each in (rollout, rollout.info, rollout.for_ticks(slice(0, 0))):
        assert "\n" not in repr(each)
        assert len(repr(each)) < 100


def test_unknown_fields_are_named(rollout):
    with pytest.raises(AttributeError, match="'speed'; it has time, setpoint, tick, info, qpos"):
        _ = rollout.speed


GATHERED = {"rates", "faults", "redraws", "complete"}
"""Fields of RunInfo that all parts of a run contribute to."""
OF_THE_START = {"params", "actuators", "start", "seed", "versions", "begun", "draws", "episodes", "description"}
"""Fields that the joined rollout has from its first part. All others are the same in all parts."""


def another(value):
    """Return a value of the same kind that is different."""
    if isinstance(value, bool) or value is None:
        return not value
    if isinstance(value, np.ndarray):
        return value + 1
    if isinstance(value, dict):
        return value | {"another": "1"}
    if isinstance(value, tuple) and hasattr(value, "_replace"):
        return value._replace(**{value._fields[0]: another(value[0])})
    if isinstance(value, tuple):
        return (*value, "another")
    if isinstance(value, Robot):
        return dataclasses.replace(value)
    return f"{value}+" if isinstance(value, str) else value + 1


@pytest.mark.parametrize("name", [each.name for each in dataclasses.fields(RunInfo)])
def test_every_field_of_a_rollout_is_joined_or_has_to_be_the_same(name, rollout):
    """The start, its draws and the origin are the first part's."""
    parts = [rollout.for_ticks(slice(0, 2)), rollout.for_ticks(slice(2, None))]
    changed = dataclasses.replace(parts[1].info, **{name: another(getattr(parts[1].info, name))})
    parts[1] = dataclasses.replace(parts[1], info=changed)
    if name not in GATHERED | OF_THE_START:
        with pytest.raises(InvalidArgumentError, match=f"parts: .*{name}"):
            Rollout.join(parts)
        return
    joined = getattr(Rollout.join(parts).info, name)
    kept = getattr(changed if name in GATHERED else parts[0].info, name)
    assert joined is kept or np.array_equal(joined, kept)


def test_redraws_and_faults_of_all_parts_are_joined(rollout):
    redraws = [(0.1, 0, 0, 1), (0.2, 1, 1, 1), (0.3, 2, 2, 1)]
    known = [(redraws[:1], ("a",)), (redraws[:2], ("a",)), (redraws[2:], ("a", "b"))]
    parts = [
        dataclasses.replace(rollout, info=dataclasses.replace(rollout.info, redraws=tuple(seen), faults=faults))
        for seen, faults in known
    ]
    info = Rollout.join(parts).info
    assert (info.redraws, info.faults, info.complete) == (tuple(redraws), ("a", "b"), True)


def test_parts_with_other_ticks_or_envs_are_refused(rollout):
    for other in (dataclasses.replace(rollout, tick=2 * rollout.tick), rollout.for_envs([0])):
        with pytest.raises(InvalidArgumentError, match="parts"):
            Rollout.join([rollout, other])
    with pytest.raises(InvalidArgumentError, match=r"parts: .*empty"):
        Rollout.join([])
