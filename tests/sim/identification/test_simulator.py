"""The simulation of a fit is the Runner's."""

import numpy as np
import pytest
from arms import DT, FALLING, STEPS, TRUTH, URDF, gains, heavier, load, motion, run

import batchpid as bp
from batchpid.motors.coupling import Coupling
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


def control(params=None, compensate="none"):
    """Return the control of a log of setpoints, or without params of efforts."""
    mode = "effort" if params is None else "pid"
    parts = {"gravity": "gravity" in compensate, "coriolis": "coriolis" in compensate}
    return Control(DT, 1, Coupling.of(2), params or bp.PIDParams(kp=None), mode, **parts)


def candidates(count=1, delay=0.0, mass=None, **actuators):
    """Return equal candidates."""
    options = {name: value for name, value in actuators.items() if value is not None}
    made = bp.make_actuators(2, **options)
    fields = {name: leaf for name, leaf in made._asdict().items() if leaf is not None}
    spread = {name: np.repeat(leaf, count, axis=0) for name, leaf in fields.items()}
    spread |= {} if made.max_delay is None else {"max_delay": made.max_delay}
    late = np.full(count, delay)
    return Candidates(bp.Actuators(**spread), None, late, 0 * late, {}, mass or {})


def stretch_of(commands, start):
    """Return a stretch whose rows are the ends of ticks."""
    table = np.repeat(commands, STEPS, axis=0)
    ends = np.arange(STEPS - 1, len(table), STEPS)
    return Stretch(start, 0.0 * start, table, 0, ends, np.zeros(len(ends)))


def simulated(robot, commands, drive, made, start):
    joints = tuple(range(len(start)))
    plant, states = LogPlant(robot, joints), np.zeros((1, 2, len(joints)))
    return simulate(plant, drive, made, states, [stretch_of(commands, start)])[0][0]


@pytest.mark.parametrize("native", ["1", "0"])
@pytest.mark.parametrize("compensate", ["none", "gravity", "gravity+coriolis", "efforts"])
@pytest.mark.parametrize("kind", MOTORS)
def test_a_log_is_simulated_as_by_the_runner(tmp_path, monkeypatch, kind, compensate, native):
    monkeypatch.setenv("BATCHPID_NATIVE", native)
    robot, commands, drive = load(tmp_path), motion(0.5), control(gains(), compensate)
    options, start = {"compensate": compensate}, commands[0]
    if compensate == "efforts":
        commands, drive, options, start = 3.0 * commands, control(), {"control": "effort"}, FALLING
    rollout = run(robot, commands, actuators=MOTORS[kind], **options)
    # The log has the measured positions.
    offset = np.array(MOTORS[kind].get("position_offset", 0.0))
    made = candidates(**(TRUTH | MOTORS[kind]))
    table = simulated(robot, commands, drive, made, start + offset)
    np.testing.assert_allclose(table - offset, rollout.qpos[:, 0], atol=1e-4)


def test_late_setpoints_and_masses_are_those_of_late_rows_and_another_description(tmp_path):
    robot, setpoints, drive = load(tmp_path), motion(0.5), control(gains())
    late = np.vstack([setpoints[:1]] * 4 + [setpoints[:-4]])
    heavy = load(tmp_path, heavier(1.5))
    expected = simulated(heavy, late, drive, candidates(**TRUTH), setpoints[0])
    changed = candidates(delay=4 * STEPS * DT, mass={"fore": np.array([1.5])}, **TRUTH)
    table = simulated(robot, setpoints, drive, changed, setpoints[0])
    np.testing.assert_allclose(table, expected, atol=1e-9)


def test_followers_move_with_their_leader(tmp_path):
    """In NumPy: lanes have no coupled joints."""
    mimic = '<mimic joint="shoulder" multiplier="-0.5" offset="0.1"/></joint></robot>'
    robot = load(tmp_path, URDF.replace("</joint></robot>", mimic))
    setpoints = motion(0.3)[:, :1] * [1.0, -0.5] + [0.0, 0.1]
    ideal = dict.fromkeys(("armature", "viscous", "coulomb"))
    rollout = run(robot, setpoints, actuators=ideal)
    made = bp.make_actuators(1, strength=0.9, command_delay=TRUTH["command_delay"])
    drive = control(gains().for_joints([0]))._replace(coupling=Coupling.of(1))
    candidate = Candidates(made, None, np.zeros(1), np.zeros(1), {}, {})
    table = simulated(robot, setpoints[:, :1], drive, candidate, setpoints[0, :1])
    np.testing.assert_allclose(table[:, 0], rollout.qpos[:, 0, 0], atol=1e-4)


def test_candidates_and_stretches_do_not_affect_each_other(tmp_path):
    robot, setpoints = load(tmp_path), motion(0.5)
    plant, drive = LogPlant(robot, (0, 1)), control(gains(), "gravity+coriolis")
    stretches = [
        stretch_of(setpoints[:40], setpoints[0]),
        stretch_of(setpoints[20:60], setpoints[20]),
    ]
    # Each candidate comes once for each stretch.
    strengths = np.array([[1.0, 1.0], [0.9, 0.9], [0.5, 1.2]])
    made = candidates(6, **TRUTH)
    motors = made.actuators._replace(strength=np.repeat(strengths, 2, axis=0))
    states = np.zeros((6, 2, 2))
    states[2:4, 1] = 0.1
    tables = simulate(plant, drive, made._replace(actuators=motors), states, stretches)
    for number, stretch in enumerate(stretches):
        for row, strength in enumerate(strengths):
            one = candidates(**TRUTH | {"strength": strength})
            (alone,) = simulate(plant, drive, one, states[2 * row : 2 * row + 1], [stretch])
            np.testing.assert_allclose(alone[0], tables[number][row], atol=1e-9)
