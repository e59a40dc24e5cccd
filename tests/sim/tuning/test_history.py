"""A search resumes from a history with the same inputs; with other inputs an error names them."""

from __future__ import annotations

import dataclasses
import inspect
import shutil
from contextlib import suppress
from tempfile import TemporaryDirectory

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from option_values import ARM, MOTORS, is_slow, option_values

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import RunnerKeywords
from batchpid.sim.tuning import Weights, random_moves, tool_candidates, tune, tune_tool

MOTOR_VALUES = [MOTORS, MOTORS._replace(coulomb=2 * MOTORS.coulomb), bp.make_actuators(2, command_delay=2e-3)]
ROBOTS = [*option_values("robot"), *(dataclasses.replace(ARM, actuators=each) for each in MOTOR_VALUES)]
INPUTS = {
    "robot": ROBOTS,
    "tool": ["arm", "hand"],
    "seed": [0, 1],
    "generations": [1, 2],
    "population": [4, 5],
    "seconds": [0.05, 0.1],
    "gain_units": ["mass_matrix", "effort"],
    "per_joint": [False, True],
    "weights": [Weights(), Weights(itae=2.0)],
    "moves": [random_moves(ARM, 1, 0), random_moves(ARM, 1, 1), None],
    "workers": [0, 1],
    "cluster": [None],
    "time_limit": [None, 1e9],
    "progress": [None, list],
    "actuators": [None, *MOTOR_VALUES],
    "motors": [None, *MOTOR_VALUES],
}
"""Values of the inputs of searches, besides those of option_values."""
QUICK = ("tool", "seed", "motors", "actuators")
"""Inputs with quick tests in the search for gains of a tool, which treats most as the other search does."""
START = {"robot": ARM, "generations": 1, "population": 4, "seconds": 0.05, "workers": 0, "engine": "mujoco"}
SEARCHES = {
    tune: START | {"moves": INPUTS["moves"][0]},
    tune_tool: START,
}


def inputs(search):
    """Return the names of the inputs of a search."""
    own = [name for name in inspect.signature(search).parameters if name not in ("history", "runner_options")]
    chosen = {tune: {"num_envs", "params"}, tune_tool: {"num_envs", "params", "control"}}[search]
    return [*own, *(name for name in RunnerKeywords.__annotations__ if name not in chosen and name not in own)]


def input_values(name):
    return INPUTS.get(name) or option_values(name)


def cheap(search):
    """Return a strategy of one or two inputs, with values that need no compilation."""
    names = st.lists(st.sampled_from(inputs(search)), min_size=1, max_size=2, unique=True)

    def chosen(name):
        return st.sampled_from([each for each in input_values(name) if not is_slow(name, each)])

    return names.flatmap(lambda names: st.tuples(*[st.fixed_dictionaries({name: chosen(name) for name in names})] * 2))


@pytest.fixture(autouse=True, scope="module")
def few_moves():
    """The searches have one move; the moves of a tool, which take seconds to find, are found once."""
    found = {}

    def tool_moves(robot, space, count, seed):
        key = str(robot.describe()), space.link, count, seed
        if key not in found:
            found[key] = tool_candidates.tool_moves(robot, space, count, seed)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("batchpid.sim.tuning.search.search_moves", lambda robot, seed: random_moves(robot, 1, seed))
        for name in ("search.FINAL_MOVES", "search.VARIED_MOVES", "tool_search.MOVES", "tool_search.FINAL_MOVES"):
            patch.setattr(f"batchpid.sim.tuning.{name}", 1)
        patch.setattr("batchpid.sim.tuning.tool_search.tool_moves", tool_moves)
        yield


def result(search, chosen, history):
    """Return the costs and gains that a search finds, as text with all digits."""
    found = search(**{**SEARCHES[search], **chosen}, history=history)
    if search is tune:
        return repr((found.history, found.cost, found.rejected, [leaf.tolist() for leaf in found.params[:3]]))
    return repr((found.options, found.costs, found.rejected))


def check_histories(search, *several):
    """Check that a history made under each of ``several`` inputs is refused under the next, or leaves its result."""
    with TemporaryDirectory() as folder:
        results = {}
        for number, chosen in enumerate(several):
            with suppress(InvalidArgumentError):  # inputs that are refused, or of which no history is kept
                results[number] = result(search, chosen, f"{folder}/{number}.json")
        for number, last in zip(results, [*results][-1:] + [*results][:-1], strict=True):
            copy = shutil.copy(f"{folder}/{last}.json", f"{folder}/copy.json")
            try:
                found = result(search, several[number], copy)
            except InvalidArgumentError as error:
                refusal = error
            else:
                refusal = None
                assert found == results[number]
            assert refusal is None or refusal.argument == "history"


@pytest.mark.parametrize("search", SEARCHES)
def test_every_input_of_a_search_has_values_to_try(search):
    """A new input needs a line in INPUTS, or in option_values."""
    assert not [name for name in inputs(search) if len(input_values(name)) < 2 and name != "cluster"]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("search", "name"),
    [
        pytest.param(search, name, marks=pytest.mark.slow if search is tune_tool and name not in QUICK else [])
        for search in SEARCHES
        for name in inputs(search)
    ],
)
def test_a_history_is_refused_or_has_no_effect_under_another_value_of_each_input(search, name):
    check_histories(search, *({name: each} for each in input_values(name) if not is_slow(name, each)))


@pytest.mark.filterwarnings("ignore")
@settings(max_examples=5, deadline=None)
@given(cheap(tune))
@example(({"robot": ROBOTS[-2], "actuators": None}, {"robot": ROBOTS[-3], "actuators": None}))
def test_a_history_under_two_inputs_is_refused_or_has_no_effect(pair):
    check_histories(tune, *pair)
