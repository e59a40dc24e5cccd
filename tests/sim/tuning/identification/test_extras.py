"""Effects beside those of every fit, found in logs of a Runner, and kept where they lower the held-out error."""

import numpy as np
import pytest

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Runner
from batchpid.sim.identification import Log, held_out_error, identify

pytest.importorskip("scipy")
pytest.importorskip("cmaes")
DT = 1 / 1000
PENDULUM = """<robot name="pendulum"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 -0.15"/>
<mass value="0.6"/><inertia ixx="0.001" iyy="0.001" izz="0.0003" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="servo" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="1 0 0"/>
<limit lower="-2.5" upper="2.5" effort="9" velocity="20"/></joint></robot>"""
GAINS = bp.make_params(1, kp=20.0, kd=0.3, effort_limit=1e3)
MOTOR = {"armature": 0.01, "viscous": 0.3, "coulomb": 0.1, "command_delay": 0.008}
OPTIONS = {"compensate": "none", "timestep": DT, "workers": 0, "payload": False}


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory) -> Robot:
    path = tmp_path_factory.mktemp("pendulum") / "pendulum.urdf"
    path.write_text(PENDULUM)
    return Robot.load(path)


@pytest.fixture
def short_search(monkeypatch):
    """The search has one generation, and short fits of neighbours and of effects."""
    monkeypatch.setattr("batchpid.sim.identification.fit_search.GENERATIONS", 1)
    monkeypatch.setattr("batchpid.sim.identification.fit_search.NEIGHBOUR_EVALUATIONS", 2)


def log_of(robot: Robot, *, gains=GAINS, rate=None, kind="setpoint", seconds=2.4, noise=1e-4, **motor) -> Log:
    """Return a log of a Runner whose servo has ``gains`` and limits the rate of its goals: sines, then steps."""
    time = DT * np.arange(round(seconds / DT))
    wave = 0.7 * np.sin(5 * time) + 0.3 * np.sin(11 * time + 1)
    goal = np.where(time % 1.2 < 0.7, wave, np.where(time % 0.4 < 0.2, 0.8, -0.6))[:, None]
    guard = None if rate is None else robot.guard(rate=rate)
    actuators = bp.make_actuators(1, **MOTOR | motor)
    options = {"params": gains, "compensate": "none", "timestep": DT, "substeps": 1, "workers": 0, "guard": guard}
    with Runner(robot, 1, **options, actuators=actuators) as runner:
        begin = runner.reset(goal[:1])
        moved = runner.rollout(goal[:, None])
        qpos = np.concatenate([begin.qpos, moved.qpos[:, 0]])[:-1].astype(float)
    qpos += noise * np.random.default_rng(0).standard_normal(qpos.shape) + motor.get("position_offset", 0.0)
    command = goal if kind == "setpoint" else moved.effort[:, 0].astype(float)
    return Log("log", (0,), kind, time, qpos, time, command, kind == "effort")


@pytest.mark.usefixtures("short_search")
@pytest.mark.quick_rows(1)
@pytest.mark.parametrize(
    ("extra", "made", "kind", "truth"),
    [
        ("load_friction", {"load_friction": 0.2}, "load_friction", 0.2),
        ("slew", {"rate": 3.0}, "slew", 3.0),
        ("saturation", {"gains": GAINS.replace(effort_max=5.0, effort_min=-5.0)}, "saturation", 0.25),
    ],
)
def test_an_effect_is_found_and_kept(pendulum, extra, made, kind, truth):
    found = identify(pendulum, log_of(pendulum, **made), params=GAINS, **OPTIONS, extras=[extra], evaluations=4)
    assert found.held_out_error[1] < 3e-4
    assert found.document()["joints"]["servo"][kind][0] == pytest.approx(truth, rel=0.05)


@pytest.mark.slow
@pytest.mark.usefixtures("short_search")
def test_an_effect_that_is_not_there_is_not_kept(pendulum):
    found = identify(pendulum, log_of(pendulum), params=GAINS, **OPTIONS, extras=["load_friction"])
    assert ("load_friction", 0) not in found.unknowns.names


@pytest.mark.slow
def test_gains_that_are_not_known_are_found(pendulum):
    guess = GAINS.replace(kp=4.0, kd=0.06)
    found = identify(pendulum, log_of(pendulum), params=guess, **OPTIONS, extras=["gain"])
    assert found.gains().kp[0, 0] == pytest.approx(20.0, rel=0.05)
    assert found.strength_taken == []


def test_effects_of_the_law_need_its_logs(pendulum):
    log = log_of(pendulum, kind="effort", seconds=2.0)
    with pytest.raises(InvalidArgumentError, match=r"extras: is of a law.*'slew'"):
        identify(pendulum, log, **OPTIONS, extras=["offset", "slew"])
    with pytest.raises(InvalidArgumentError, match=r"extras: .*'backlash'"):
        identify(pendulum, log, **OPTIONS, extras=["backlash"])


@pytest.mark.slow
def test_the_file_moves_as_it_was_found(pendulum, tmp_path):
    log = log_of(pendulum, rate=3.0, load_friction=0.1, position_offset=0.05)
    found = identify(pendulum, log, params=GAINS, **OPTIONS, extras=["slew", "load_friction", "offset"])
    found.save(tmp_path / "motors.yaml")
    same = {name: OPTIONS[name] for name in ("compensate", "timestep")}
    errors = held_out_error(pendulum, [log], tmp_path / "motors.yaml", params=found.gains(), **same)
    np.testing.assert_allclose(errors[1], found.held_out_error[1], rtol=1e-6)
