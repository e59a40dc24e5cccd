"""Commands that are not one number for each joint: the position (x, z) of a two-link arm;
test_conformance.py runs one on every path.
"""

import numpy as np
import pytest
from tiny_urdf import INERTIAL, joint, link, robot, write

from batchpid.errors import InvalidArgumentError
from batchpid.sim import (
    CommandSpec,
    FaultWarning,
    Robot,
    RunInfo,
    Runner,
    RunnerOptions,
    write_recording,
)
from batchpid.sim.identification import identify
from batchpid.sim.tuning.evaluation import step_response_metrics

N, LENGTH = 5, 1.0
"""Envs, and length of each link [m]; both joints turn about y, and the arm hangs up along z at
0.
"""
XY = CommandSpec(("x", "z"), ("m", "m"), neutral=(0.8, 0.8))


class Cartesian:
    """PD of both joints toward the elbow-up solution of the inverse kinematics of (x, z), in NumPy
    or JAX.
    """

    def __init__(self, command=XY):
        self.command = command

    def init(self, robot, num_envs, timestep):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        xp = setpoint.__array_namespace__()
        x, z = setpoint[:, 0], setpoint[:, 1]
        cosine = (x * x + z * z) / (2 * LENGTH**2) - 1
        elbow = xp.arccos(xp.clip(cosine, -1.0, 1.0))
        target = xp.stack([xp.arctan2(x, z) - elbow / 2, elbow], -1)
        return state, passive + 60.0 * (target - qpos) - 15.0 * qvel


@pytest.fixture(scope="session")
def arm(tmp_path_factory):
    """Two links of 1 m, the tool at the end of the second."""
    limit = '<limit lower="-3" upper="3" effort="200" velocity="9"/>'
    text = robot(
        *(link(name, INERTIAL) for name in ("base", "upper", "lower")),
        joint("shoulder", "base", "upper", inner=limit, origin="0 0 0"),
        joint("elbow", "upper", "lower", inner=limit, origin=f"0 0 {LENGTH}"),
    )
    return Robot.load(write(tmp_path_factory.mktemp("arm"), text))


def goals(num_envs=N):
    return np.random.default_rng(3).uniform(0.5, 1.1, (num_envs, 2))


def make(arm, control=None, num_envs=N, **options):
    return Runner(
        arm, num_envs, control=control or Cartesian(), **({"workers": 0, "substeps": 20} | options)
    )


def test_followers_do_not_enter_a_command(tmp_path):
    """The efforts that a controller returns for followers act on leaders; setpoints are passed on
    as they are.
    """
    mimic = (
        '<limit lower="-3" upper="3" effort="200" velocity="9"/><mimic joint="elbow"'
        ' multiplier="-1"/>'
    )
    limit = mimic.partition("<mimic")[0]
    text = robot(
        *(link(name, INERTIAL) for name in ("base", "upper", "lower", "finger")),
        joint("shoulder", "base", "upper", inner=limit),
        joint("elbow", "upper", "lower", inner=limit),
        joint("tip", "lower", "finger", inner=mimic),
    )
    coupled = Robot.load(write(tmp_path, text))

    class Efforts(Cartesian):
        def __call__(self, state, setpoint, qpos, qvel, passive):
            return state, setpoint[:, :1] * np.ones_like(qpos)

    setpoint = np.array([1.0, 2.0, 3.0, 4.0])
    with make(coupled, Efforts(CommandSpec(("a", "b", "c", "d")))) as runner:
        runner.step(setpoint, setpoint_rate=setpoint)
        np.testing.assert_array_equal(runner.rollout(setpoint[None]).setpoint[0], [setpoint] * N)


def test_one_number_is_a_command_too(arm):
    class Height(Cartesian):
        def __call__(self, state, setpoint, qpos, qvel, passive):
            return super().__call__(state, np.hstack([setpoint, setpoint]), qpos, qvel, passive)

    with make(arm, Height(CommandSpec(("height",))), num_envs=2) as runner:
        for setpoint in (0.7, [0.7], [[0.7], [0.9]]):
            runner.step(setpoint)
        assert runner.command == CommandSpec(("height",))


def test_a_spec_fills_in_units_and_neutral():
    spec = CommandSpec(["x", "y"])
    assert (spec.size, spec.units, spec.neutral) == (2, ("", ""), (0.0, 0.0))
    assert spec == CommandSpec(("x", "y"))
    assert CommandSpec(("x", "y"), ("m", "")).labels == ("x [m]", "y")


def test_commands_of_joints_have_their_names_and_units(panda):
    position, effort = ("rad",) * 7 + ("m", "m"), ("N m",) * 7 + ("N", "N")
    for control, units in (
        ("pid", position),
        ("drive", position),
        ("effort", effort),
        (Cartesian(None), position),
    ):
        options = RunnerOptions(panda, 1, control=control)
        assert options.command == CommandSpec(panda.joint_names, units)
        info = RunInfo.of(panda, control=options.control_name)
        assert (info.command, info.sets_positions) == (options.command, control != "effort")
        assert info.units_of("qvel") == ("rad/s",) * 7 + ("m/s", "m/s")


def test_a_fault_names_the_entry_and_the_env_has_the_neutral_setpoint(arm):
    class Noting(Cartesian):
        def __call__(self, state, setpoint, qpos, qvel, passive):
            self.last = setpoint
            return super().__call__(state, setpoint, qpos, qvel, passive)

    control, bad = Noting(), goals()
    bad[1, 1], bad[3, 0] = np.nan, np.inf
    with make(arm, control, on_invalid_input="contain") as runner:
        with pytest.warns(FaultWarning, match="env 1, 'z': its setpoint is not finite"):
            failed = runner.step(bad)
        np.testing.assert_array_equal(failed.ok, [True, False, True, False, True])
        faults = [(fault.env, fault.joint, fault.cause) for fault in runner.faults]
        assert faults == [(1, "z", "setpoint"), (3, "x", "setpoint")]
    np.testing.assert_array_equal(control.last, np.where(failed.ok[:, None], goals(), XY.neutral))


@pytest.fixture(scope="module")
def rollout(arm):
    """A run of three numbers in a setpoint of two joints."""
    command = CommandSpec(("x", "z", "gain <b>"), ("m", "m", ""))
    setpoints = np.random.default_rng(2).uniform(0.5, 1.1, (12, N, 3))
    with make(arm, Cartesian(command)) as runner:
        return runner.rollout(setpoints)


def test_identification_and_metrics_refuse_such_runs(arm, rollout, tmp_path):
    path = write_recording(rollout, tmp_path / "run.h5")
    for call in (
        lambda: step_response_metrics(arm, rollout, np.zeros((N, 2))),
        lambda: identify(arm, [path]),
    ):
        with pytest.raises(InvalidArgumentError, match="not of joints"):
            call()
