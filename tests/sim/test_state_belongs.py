"""State of one runner is refused in another, or gives the same result there: for every option."""

from dataclasses import fields
from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from identical import assert_identical
from option_values import ARM, DECLARED, VALUES, is_slow, option_values

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Randomization, Runner, RunnerOptions, Uniform
from batchpid.sim.gym import ReachVectorEnv

BASE = {
    "robot": ARM,
    "num_envs": 2,
    "workers": 0,
    "substeps": 20,
    "ground": True,
    "engine": "sapien",
    "build": VALUES["build"][0],
}
"""In the run a box falls."""
CONTEXTS = [
    {},
    {"build": None, "ground": None},
    {"control": "osc"},
    {"backend": "jax"},
    {"build": None, "ground": None, "engine": "mujoco"},
    {"workers": None, "build": None, "ground": None},
]
"""Further options that a value may need."""
NAMES = [each.name for each in fields(RunnerOptions)]


def quick(name):
    """Return the values for random pairs."""
    return [
        each for each in option_values(name) if name != "workers" and not is_slow(name, each)
    ] or [BASE[name]]


def go_on(runner):
    """Return the next observations, and the final poses of the boxes."""
    pose = runner.options.command.size > 2
    start = runner.observe()
    seen = []
    for _ in range(5):
        setpoint = start.tool_pose + 0.0 if pose else start.qpos + 0.0
        setpoint[1:, 0] += 0.6
        seen.append(runner.step(setpoint, substeps=40))
    return seen, runner.poses() if runner.options.build is not None else None


def is_possible(chosen):
    options = {name: value for name, value in {**BASE, **chosen}.items() if name != "params"}
    try:
        found = RunnerOptions(**options)
    except InvalidArgumentError:
        return False
    return found.collisions or found.build is None  # which has shapes


@cache
def in_context(number):
    """Return a snapshot under one of CONTEXTS, and what followed."""
    return went_on(CONTEXTS[number])


def made(chosen):
    return Runner(**{**BASE, **chosen})


def went_on(chosen):
    with made(chosen) as runner:
        goal = runner.observe()
        for _ in range(2):
            runner.step(goal.qpos if goal.tool_pose is None else goal.tool_pose, substeps=10)
        return runner.snapshot(), go_on(runner)


def changed(ours, theirs):
    """Return the names of options with other values."""
    given, other = (BASE | each for each in (ours, theirs))
    return [
        name for name in given.keys() | other if given.get(name, ...) is not other.get(name, ...)
    ]


def check(ours, theirs, before=None):
    """Check that a snapshot made under ``ours`` is refused, or gives the same, under ``theirs``."""
    snapshot, (expected, ends) = before or went_on(ours)
    with made(theirs) as other:
        try:
            other.restore(snapshot)
        except InvalidArgumentError as error:
            refusal = error
        else:
            refusal, (found, places) = None, go_on(other)
    if refusal is not None:
        assert refusal.argument == "snapshot"
        kept = [name for name in changed(ours, theirs) if "snapshot" in DECLARED[name].places]
        assert kept, "these options belong to no snapshot"
        assert "robot" in kept or any(name in str(refusal) for name in kept), "the option is named"
        return
    for one, two in zip(expected, found, strict=True):
        assert_identical(one, two)
    np.testing.assert_array_equal(places, ends)


def test_every_option_is_kept_or_has_a_role_apart():
    reasons = {"snapshot", "restored", "processes", "next commands"}
    for option in fields(RunnerOptions):
        assert len(reasons & DECLARED[option.name].places.keys()) == 1, option.name


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "index"),
    [
        pytest.param(name, index, marks=pytest.mark.slow if name == "cluster" else [])
        for name in NAMES
        for index in range(len(option_values(name)))
    ],
)
def test_a_snapshot_is_refused_or_goes_on_as_before_under_each_value_of_each_option(
    name, index, request
):
    """The snapshot is made under the value before it, the last one for the first."""
    before, value = option_values(name)[index - 1], option_values(name)[index]
    if value == "jax":
        request.getfixturevalue("needs_jax")
    number, context = next(
        each for each in enumerate(CONTEXTS) if is_possible({**each[1], name: value})
    )
    if is_possible({**context, name: before}):
        check({**context, name: before}, {**context, name: value})
    else:
        check(context, {**context, name: value}, in_context(number))


def test_each_option_has_a_value_to_try_besides_its_default():
    """A new option needs a line in VALUES, unless its type lists its values."""
    default = {each.name: each.default for each in fields(RunnerOptions)}
    assert not [
        name
        for name in NAMES
        if {repr(each) for each in option_values(name)} <= {repr(default[name])}
    ]


PAIRS = st.lists(st.sampled_from(NAMES), min_size=1, max_size=2, unique=True).flatmap(
    lambda names: st.tuples(
        *[st.fixed_dictionaries({name: st.sampled_from(quick(name)) for name in names})] * 2
    )
)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("examples", [12, pytest.param(800, marks=pytest.mark.slow)])
def test_a_snapshot_under_any_two_options_is_refused_or_goes_on_as_before(examples):
    @settings(max_examples=examples, deadline=None)
    @given(PAIRS)
    def try_pairs(pair):
        assume(all(map(is_possible, pair)))
        check(*pair)

    try_pairs()


@pytest.mark.filterwarnings("ignore")
def test_a_drawn_start_is_the_first_setpoint():
    drawn = Randomization(qpos=Uniform(-0.2, 0.2))
    options = {"workers": 0, "actions": "increment", "engine": "mujoco", "max_episode_steps": 3}
    env = ReachVectorEnv(2, randomization=drawn, **options)
    with env.runner:
        env.reset(seed=1)
        start, ended = env.observed.qpos, False
        for _ in range(8):
            *_, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
            if truncated.any() or ended:
                start = env.observed.qpos
            else:
                assert np.abs(env.observed.qpos - start).max() < 0.02
            ended = truncated.any()
