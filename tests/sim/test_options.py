"""Options of a Runner: names, defaults, checked values, and the places that keep them."""

import ast
import dataclasses
import inspect
import pickle
import re
import sys
from dataclasses import fields
from itertools import pairwise
from typing import get_type_hints

import numpy as np
import pytest
from option_values import DECLARED
from robots import load_bundled

import batchpid as bp
import batchpid.sim
from batchpid.errors import MissingDependencyError
from batchpid.sim import Runner, RunnerOptions
from batchpid.sim.cli import parse
from batchpid.sim.options.options import OPTION_GROUPS, RunnerKeywords

PANDA = load_bundled("panda")
OWN = bp.make_actuators(PANDA.dof, coulomb=0.3, armature=0.05, command_delay=0.002)
GEARED = dataclasses.replace(PANDA, actuators=OWN)


def test_every_keyword_is_an_option_and_is_shown_with_its_default():
    robot, num_envs, *options = inspect.signature(Runner).parameters.values()
    defaults = {entry.name: entry.default for entry in fields(RunnerKeywords)}
    declared = get_type_hints(RunnerKeywords)
    assert (robot.name, num_envs.name) == ("robot", "num_envs")
    assert {*DECLARED} == {"robot", "num_envs", *(parameter.name for parameter in options)}
    for parameter in options:
        name = parameter.name
        assert parameter.kind is inspect.Parameter.KEYWORD_ONLY
        assert parameter.default == defaults[name], name
        assert parameter.annotation == declared[name], name
        assert re.search(rf"\b{name}\b", Runner.__doc__), name


def test_public_names_and_modules_are_attributes_that_editors_list():
    for package in (bp, batchpid.sim):
        for name in dir(package):
            assert getattr(package, name) is not None
    assert {"Runner", "tuning", "plots"} <= {*dir(batchpid.sim)}
    assert {"sim", "trajectories", "metrics", "export", "task_space"} <= {*dir(bp)}
    for module, name in ((bp, "simulation"), (batchpid.sim, "runners")):
        with pytest.raises(AttributeError, match=name):
            getattr(module, name)


def test_a_missing_jax_is_named_with_its_extra_before_a_worker_starts(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    with pytest.raises(
        MissingDependencyError, match=r"backend='jax' needs the package 'jax'.*\.\[jax\]"
    ):
        Runner(PANDA, 1, backend="jax")


def test_a_flag_of_an_option_has_its_default_and_reaches_the_runner():
    flags = {each.name: each.default for each in fields(RunnerKeywords) if DECLARED[each.name].flag}
    _, values = parse(["rollout"])
    assert flags.items() <= vars(values).items()
    _, values = parse(["rollout", "--workers", "2", "--engine", "mujoco"])
    assert (values.workers, values.engine) == (2, "mujoco")


def test_every_option_is_documented_where_it_is_declared():
    texts = {}
    for group in (*OPTION_GROUPS, RunnerKeywords):
        for declaration, text in pairwise(ast.parse(inspect.getsource(group)).body[0].body):
            if isinstance(declaration, ast.AnnAssign):
                texts[declaration.target.id] = text
    assert texts.keys() == DECLARED.keys()
    assert all(isinstance(text, ast.Expr) for text in texts.values())


def test_options_are_plain_values_of_their_documented_type():
    options = RunnerOptions(PANDA, np.int64(2), substeps=np.int8(3), timestep=np.float32(1e-3))
    assert (type(options.num_envs), type(options.substeps), type(options.timestep)) == (
        int,
        int,
        float,
    )


def test_defaults_are_resolved():
    options = RunnerOptions(PANDA, 2)
    assert isinstance(options.workers, int)
    assert (options.ground, options.guard) == (PANDA.has_ground, None)
    guarded = RunnerOptions(PANDA, 2, guard=True, collisions=False)
    assert guarded.ground is False
    np.testing.assert_array_equal(guarded.guard.upper, PANDA.guard().upper)
    assert (
        RunnerOptions(PANDA, 2, guard=False).guard
        is RunnerOptions(PANDA, 2, guard=None).guard
        is None
    )


def test_options_cannot_be_changed():
    options = RunnerOptions(PANDA, 2, guard=True)
    with pytest.raises(dataclasses.FrozenInstanceError):
        options.timestep = 1e-3
    other = options.changed(workers=3)
    assert (other.workers, other.guard, other.timestep) == (3, options.guard, options.timestep)
    assert options.workers != 3


def test_options_travel_to_workers_as_they_are():
    options = RunnerOptions(GEARED, 2, actuators=bp.Actuators(), guard=True)
    received = pickle.loads(pickle.dumps(options))
    assert received.actuators is None
    assert received.described == options.described


@pytest.mark.parametrize("control", ["pid", "drive"])
def test_no_actuators_are_those_of_the_robot(control):
    expected = OWN.joint_side() if control == "drive" else OWN

    def check(actuators):
        assert (actuators.command_delay is None) == (expected.command_delay is None)
        np.testing.assert_array_equal(actuators.coulomb, expected.coulomb)
        np.testing.assert_array_equal(actuators.armature, expected.armature)

    with Runner(GEARED, 2, workers=0, control=control) as runner:
        check(runner.actuators)
    with Runner(GEARED, 2, workers=0, control=control, actuators=bp.Actuators()) as ideal:
        assert ideal.actuators is None
        snapshot = ideal.snapshot()
    with Runner(GEARED, 2, workers=0, control=control) as runner:
        runner.restore(snapshot)
        assert runner.actuators is None, "as in the snapshot"
        runner.step(PANDA.start)
