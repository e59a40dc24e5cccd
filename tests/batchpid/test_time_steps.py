"""A rate in place of a time step is refused by every public function that takes one, with the remedy."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from trees import planar, robot_of

import batchpid as bp
import batchpid.export
import batchpid.task_space as ts
from batchpid import metrics, motors, trajectories
from batchpid.errors import InvalidArgumentError
from batchpid.motors import friction, guard

MODULES = (bp, batchpid.export, ts, motors, motors.presets, friction, guard, metrics, trajectories)
Y, TREE = np.zeros((1, 2)), planar()
PARAMS = bp.make_params(2, 4.0, 1.0, 1.0, integration="integrate_first")
OSC = ts.make_osc_params(TREE, integral_gain=1.0)
POSE = ts.link_poses(TREE, Y, ["tip"])[:, 0]
MOTORS, GUARD = bp.make_actuators(2, lag=0.1), bp.make_guard(2, rate=1.0)
RUBBING = friction.Friction(np.ones((1, 2)), np.ones((1, 2)))
VALUES = {
    "num_envs": 1, "joints": 2, "joint_names": ["a", "b"], "measurement": Y, "setpoint": Y, "effort": Y, "qpos": Y,
    "qvel": Y, "tree": TREE, "link": "tip", "mass_matrix": np.eye(2), "inertia": np.ones((1, 2)), "kp": 1.0, "ki": 1.0,
    "kd": 1.0, "params": PARAMS, "actuators": MOTORS, "min_delay": 0, "max_delay": 1, "load": Y,
    "guard": GUARD, "friction": RUBBING, "velocity": Y, "start": Y, "target": Y + 1, "end": Y + 1, "max_velocity": 1.0,
    "max_acceleration": 1.0, "max_jerk": 1.0, "robot": robot_of("panda"),
}  # fmt: skip
"""Values of required arguments, by their names."""
OSC_VALUES = {"params": OSC, "state": ts.init(OSC, Y), "setpoint": POSE}
OWN = {
    "batchpid": {"state": bp.init(PARAMS, Y)},
    "batchpid.task_space": OSC_VALUES | {"dynamics": ts.task_dynamics(TREE, Y, Y, "tip")},
    "batchpid.trajectories": {"duration": 1.0},
    "batchpid.metrics": {"setpoint": np.ones((9, 1, 2)), "measurement": np.zeros((9, 1, 2))},
    "batchpid.motors": {"state": motors.init(MOTORS, Y, 0.01)},
    "batchpid.motors.guard": {"state": guard.init(GUARD, Y)},
    "batchpid.motors.friction": {
        "mass_matrix": np.eye(2)[None],
        "state": friction.init(RUBBING, Y, Y, np.eye(2)[None], 0.01),
    },
}
STEPS = ("dt", "timestep")


def public(module):
    """Yield the public callables of a module."""
    own = (name for name, each in vars(module).items() if getattr(each, "__module__", None) == module.__name__)
    for name in getattr(module, "__all__", [name for name in own if not name.startswith("_")]):
        each = getattr(module, name)
        if callable(each) and not (isinstance(each, type) and issubclass(each, Exception)):
            yield name, each


def found():
    for module in MODULES:
        for name, function in public(module):
            parameters = inspect.signature(function).parameters
            for step in set(STEPS) & parameters.keys():
                yield pytest.param(module.__name__, function, step, id=f"{module.__name__}.{name}")


@pytest.mark.parametrize("rate", [2000, np.float32(50.0), np.int64(240)])
@pytest.mark.parametrize(("module", "function", "step"), list(found()))
def test_a_rate_is_refused_and_its_step_is_not(module, function, step, rate):
    if function is trajectories.jerk_limited:
        pytest.importorskip("ruckig")
    values = VALUES | OWN.get(module, {})
    chosen = {"duration"} if function is trajectories.minimum_jerk else set()
    needed = {
        name: values[name]
        for name, each in inspect.signature(function).parameters.items()
        if name in chosen or (each.default is each.empty and name != step and each.kind is not each.VAR_KEYWORD)
    }
    function(**needed, **{step: float(1 / rate)})
    with pytest.raises(InvalidArgumentError, match=rf"{step}: .*seconds, 1/{rate:g}"):
        function(**needed, **{step: rate})


def test_arrays_of_rates_are_refused():
    with pytest.raises(InvalidArgumentError, match="seconds, 1/2000"):
        bp.step(PARAMS, bp.init(PARAMS, Y), Y, Y, np.array([[0.001, 2000.0]]))
