"""The simulation of a fit is the Runner's."""

from __future__ import annotations

import numpy as np
import pytest
from arms import DT, FALLING, STEPS, TRUTH, gains, load, motion, run

import batchpid as bp
from batchpid.motors.coupling import Coupling
from batchpid.sim import Robot
from batchpid.sim.identification.simulator import Candidates, LogPlant, Stretch, simulate
from batchpid.stages import Control

MOTORS = {
    "ideal": dict.fromkeys(TRUTH),
    "late and weak": {},
    "stiction and load": {
        "static": [0.8, 0.4],
        "stribeck": [0.2, 0.1],
        "load_friction": [0.1, 0.05],
    },
    "offset": {"position_offset": [0.02, -0.01]},
}


def control(params=None, compensate="none") -> Control:
    """Return the control of a log of setpoints, or without params of efforts."""
    mode = "effort" if params is None else "pid"
    parts = "gravity" in compensate, "coriolis" in compensate
    law = params or bp.PIDParams(kp=None)
    return Control(DT, 1, Coupling.of(2), law, mode, gravity=parts[0], coriolis=parts[1])


def candidates(
    count=1, law=None, delay=0.0, lag=0.0, payload=None, mass=None, **actuators
) -> Candidates:
    """Return equal candidates."""
    made = bp.make_actuators(
        2, **{name: value for name, value in actuators.items() if value is not None}
    )
    spread = {
        name: np.repeat(leaf, count, axis=0)
        for name, leaf in made._asdict().items()
        if leaf is not None
    }
    spread |= {} if made.max_delay is None else {"max_delay": made.max_delay}
    late = (np.full(count, time) for time in (delay, lag))
    return Candidates(bp.Actuators(**spread), law or {}, *late, payload or {}, mass or {})


def stretch_of(commands, start) -> Stretch:
    """Return a stretch whose rows are the ends of ticks."""
    table = np.repeat(commands, STEPS, axis=0)
    ends = np.arange(STEPS - 1, len(table), STEPS)
    return Stretch(start, np.zeros(2), table, 0, ends, np.zeros(len(ends)))


def simulated(robot: Robot, commands, drive: Control, made: Candidates, start) -> np.ndarray:
    (table,) = simulate(
        LogPlant(robot, (0, 1)), drive, made, np.zeros((1, 2, 2)), [stretch_of(commands, start)]
    )
    return table[0]


@pytest.mark.parametrize("native", ["1", "0"])
@pytest.mark.parametrize("compensate", ["none", "gravity", "gravity+coriolis"])
@pytest.mark.parametrize("kind", MOTORS)
def test_a_log_of_setpoints_is_simulated_as_by_the_runner(
    tmp_path, monkeypatch, kind, compensate, native
):
    monkeypatch.setenv("BATCHPID_NATIVE", native)
    robot, setpoints = load(tmp_path), motion(0.5)
    rollout = run(robot, setpoints, compensate=compensate, actuators=MOTORS[kind])
    drive = control(gains(), compensate)
    offset = np.array(
        MOTORS[kind].get("position_offset", 0.0)
    )  # the log has the measured positions
    table = simulated(
        robot, setpoints, drive, candidates(**(TRUTH | MOTORS[kind])), setpoints[0] + offset
    )
    np.testing.assert_allclose(table - offset, rollout.qpos[:, 0], atol=1e-4)


@pytest.mark.parametrize("kind", MOTORS)
def test_a_log_of_efforts_is_simulated_as_by_the_runner(tmp_path, kind):
    robot = load(tmp_path)
    commands = 3.0 * motion(0.5)
    rollout = run(robot, commands, "effort", actuators=MOTORS[kind])
    made, offset = (
        candidates(**(TRUTH | MOTORS[kind])),
        np.array(MOTORS[kind].get("position_offset", 0.0)),
    )
    table = simulated(robot, commands, control(), made, FALLING + offset)
    np.testing.assert_allclose(table - offset, rollout.qpos[:, 0], atol=1e-4)


def test_delays_and_rate_limits_of_setpoints_are_those_of_late_rows_and_a_guard(tmp_path):
    robot, setpoints = load(tmp_path), motion(0.5)
    drive = control(gains())
    late = np.vstack([setpoints[:1]] * 4 + [setpoints[:-4]])
    expected = simulated(robot, late, drive, candidates(**TRUTH), setpoints[0])
    table = simulated(
        robot, setpoints, drive, candidates(delay=4 * STEPS * DT, **TRUTH), setpoints[0]
    )
    np.testing.assert_allclose(table, expected, atol=1e-9)
    rollout = run(robot, setpoints, guard=robot.guard(rate=np.array([1.0, 0.5])))
    slew = {"slew": np.array([[1.0, 0.5]])}
    table = simulated(robot, setpoints, drive, candidates(law=slew, **TRUTH), setpoints[0])
    np.testing.assert_allclose(table, rollout.qpos[:, 0], atol=1e-4)


def test_masses_are_those_of_another_description(tmp_path):
    robot, setpoints = load(tmp_path), motion(0.5)
    text = (tmp_path / "arm.urdf").read_text()
    heavy = text.replace('mass value="1"', 'mass value="1.5"').replace('ixx="0.01"', 'ixx="0.015"')
    heavy = heavy.replace('iyy="0.01"', 'iyy="0.015"').replace('izz="0.002"', 'izz="0.003"')
    drive = control(gains())
    table = simulated(
        robot,
        setpoints,
        drive,
        candidates(mass={"fore": np.array([1.5])}, **TRUTH),
        setpoints[0],
    )
    other = load(tmp_path, heavy)
    np.testing.assert_allclose(
        table, simulated(other, setpoints, drive, candidates(**TRUTH), setpoints[0]), atol=1e-9
    )
    loaded = simulated(
        robot,
        setpoints,
        drive,
        candidates(payload={"fore": np.array([0.5])}, **TRUTH),
        setpoints[0],
    )
    assert np.abs(loaded - table).max() < np.abs(loaded - run(robot, setpoints).qpos[:, 0]).max()


def test_candidates_and_stretches_do_not_affect_each_other(tmp_path):
    robot, setpoints = load(tmp_path), motion(0.5)
    plant, drive = LogPlant(robot, (0, 1)), control(gains(), "gravity+coriolis")
    stretches = [stretch_of(setpoints, setpoints[0]), stretch_of(setpoints[20:60], setpoints[20])]
    # Each candidate comes once for each stretch.
    strengths = np.array([[1.0, 1.0], [0.9, 0.9], [0.5, 1.2]])
    made = candidates(6, **TRUTH)
    motors = made.actuators._replace(strength=np.repeat(strengths, 2, axis=0))
    states = np.zeros((6, 2, 2))
    states[2:4, 1] = 0.1
    made = made._replace(actuators=motors)
    tables = simulate(plant, drive, made, states, stretches)
    for number, stretch in enumerate(stretches):
        for row, strength in enumerate(strengths):
            one = candidates(**TRUTH | {"strength": strength})
            (alone,) = simulate(plant, drive, one, states[2 * row : 2 * row + 1], [stretch])
            np.testing.assert_allclose(alone[0], tables[number][row], atol=1e-9)
