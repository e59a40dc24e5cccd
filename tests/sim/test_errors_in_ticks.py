"""An error in the middle of a tick closes the runner: the same error, time and recording for any
number of workers.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import load_bundled

from batchpid.errors import BatchPIDError, ClosedError, ControllerError, InvalidArgumentError
from batchpid.sim import Runner

ROBOT = load_bundled("panda")
ENVS, SUBSTEPS, TICKS = 20, 4, 6  # 20 envs: two groups with workers=0
MARKS = np.repeat(np.arange(float(ENVS))[:, None], ROBOT.dof, 1)


class FailsLater:
    """Controller that fails in some envs, each at a sim step; an env knows its number by its
    setpoint.
    """

    def __init__(self, failures, kind="raises"):
        self.failures, self.kind = failures, kind

    def init(self, robot, num_envs, timestep):
        return np.zeros(num_envs, int)

    def __call__(self, state, setpoint, qpos, qvel, passive):
        state = state + 1
        for env, step in self.failures:
            if ((setpoint[:, 0] == env) & (state == step)).any():
                return self.fail(env, state, passive)
        return state, passive + 2 * np.sin(setpoint)

    def fail(self, env, state, passive):
        if self.kind == "raises":
            raise ZeroDivisionError(f"mark {env}")
        if self.kind == "raises an error of ours":
            raise BatchPIDError(f"mark {env}")
        return (state, passive[:, :2]) if self.kind == "wrong shape" else None


def run(runner, way):
    if way == "rollout":
        runner.rollout(np.broadcast_to(MARKS, (TICKS, *MARKS.shape)))
    for _ in range(TICKS):
        runner.step(MARKS)


def outcome(workers, controller, way="rollout", **options):
    """Return the error of a run, and the remaining state of the runner."""
    with Runner(
        ROBOT, ENVS, workers=workers, control=controller, substeps=SUBSTEPS, timeout=20.0, **options
    ) as runner:
        with pytest.raises(BatchPIDError) as info:
            run(runner, way)
        assert runner.closed
        with pytest.raises(ClosedError, match="since a call failed"):
            runner.observe()
        return type(info.value), str(info.value), runner.time, list(runner.faults)


@settings(max_examples=2, deadline=None)
@given(
    workers=st.sampled_from([1, 2]),
    failures=st.lists(
        st.tuples(st.integers(0, ENVS - 1), st.integers(1, SUBSTEPS * TICKS)),
        min_size=1,
        max_size=3,
    ),
    kind=st.sampled_from(["raises", "raises an error of ours", "wrong shape", "no pair"]),
    way=st.sampled_from(["rollout", "step"]),
)
def test_any_number_of_workers_ends_in_the_same_error_and_state(workers, failures, kind, way):
    controller = FailsLater(sorted(failures), kind)
    one, other = (outcome(each, controller, way=way) for each in (0, workers))
    assert one == other
    first = min(step for _, step in failures)
    assert one[0] is ControllerError
    assert f"in sim step {first} (" in one[1]
    ticks = (first - 1) // SUBSTEPS if way == "step" else 0
    assert one[2] == pytest.approx(ticks * SUBSTEPS / 2000), "the time before the call"


@pytest.mark.parametrize("workers", [0, 1])
def test_the_controllers_own_traceback_is_shown(workers):
    runner = Runner(ROBOT, 2, workers=workers, control=FailsLater([(1, 3)]), substeps=SUBSTEPS)
    with (
        runner,
        pytest.raises(ControllerError, match="FailsLater raised ZeroDivisionError: mark 1") as info,
    ):
        runner.step(MARKS[:2])
    error = info.value
    assert isinstance(error, InvalidArgumentError)
    assert (error.argument, error.step) == ("control", 3)
    shown = "".join(getattr(error, "__notes__", [])) if workers else repr(error.__cause__)
    assert "ZeroDivisionError" in shown


def reset_often(runner):
    for _ in range(6):
        runner.reset()


@pytest.mark.parametrize("workers", [0, 2])
def test_an_error_in_a_reset_closes_the_runner(workers):
    class FailsAtReset(FailsLater):
        def __init__(self):
            super().__init__([])
            self.calls = 0

        def init(self, robot, num_envs, timestep):
            self.calls += 1
            if self.calls > 4:
                raise BatchPIDError("no more")
            return super().init(robot, num_envs, timestep)

    with Runner(ROBOT, 4, workers=workers, control=FailsAtReset()) as runner:
        with pytest.raises(ControllerError, match="no more"):
            reset_often(runner)
        assert runner.closed
