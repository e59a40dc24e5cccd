"""Fits of logs with settings of their own, and of efforts that were measured; intervals from parts of logs."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import batchpid as bp
from batchpid.sim import Robot
from batchpid.sim.identification import Log, identify, measured_motors
from batchpid.sim.identification.statistics import jackknife_variance

pytest.importorskip("scipy")
EXAMPLE = runpy.run_path(str(Path(__file__).parents[4] / "examples/real_logs.py"))
DT = EXAMPLE["DT"]


def hinge(folder: Path, mass: float = 0.8) -> Robot:
    path = folder / f"hinge{mass}.urdf"
    path.write_text(EXAMPLE["URDF"].replace('mass value="0.8"', f'mass value="{mass}"'))
    return Robot.load(path)


@pytest.fixture
def short_search(monkeypatch):
    monkeypatch.setattr("batchpid.sim.identification.fit_search.GENERATIONS", 1)
    monkeypatch.setattr("batchpid.sim.identification.fit_search.NEIGHBOUR_EVALUATIONS", 1)


@pytest.mark.usefixtures("short_search")
def test_logs_of_several_gains_and_loads_are_fitted_together(tmp_path):
    """The load is a payload in one log and a URDF of its own in another; the third log is held out."""
    robot, motion = hinge(tmp_path), EXAMPLE["wave"](0.8)
    hinge(tmp_path, 1.2)
    entries = []
    for number, (mass, kp, own) in enumerate(
        [(0.8, 30.0, ""), (1.2, 15.0, "payload: 0.4"), (1.2, 20.0, "urdf: hinge1.2.urdf, held_out: true")]
    ):
        params = bp.make_params(1, kp=kp, effort_limit=12.0)
        bp.save_params(tmp_path / f"{number}.yaml", params, robot.joint_names)
        time, qpos, _ = EXAMPLE["move"](hinge(tmp_path, mass), "servo", motion, params)
        table = np.column_stack([time, motion, qpos])
        header = "time,setpoint:hinge,qpos:hinge"
        np.savetxt(tmp_path / f"{number}.csv", table, delimiter=",", header=header, comments="")
        entries.append(f"- {{{', '.join(filter(None, [f'log: {number}.csv, gains: {number}.yaml', own]))}}}")
    (tmp_path / "runs.yaml").write_text("\n".join(["logs:", *entries]))
    options = {"compensate": "none", "timestep": DT, "payload": False, "workers": 0, "evaluations": 4}
    found = identify(robot, [tmp_path / "runs.yaml"], **options)
    estimate = dict(zip(found.unknowns.names, found.estimate, strict=True))
    assert estimate["strength", 0] == pytest.approx(0.5, rel=0.01)
    assert estimate["armature", 0] == pytest.approx(0.02, rel=0.03)
    assert estimate["delay", None] == pytest.approx(0.004, abs=1e-4)
    assert [fit.fitted.any() for fit in found.fits] == [True, True, False]
    assert all(fit.fitted.all() for fit in found.fits[:2])
    assert found.held_out_error[1] < 3e-4
    (tmp_path / "runs.yaml").write_text("logs:\n- {log: 0.csv, gains: 0.yaml, held_out: true}")
    with pytest.raises(bp.InvalidArgumentError, match="are all held out"):
        identify(robot, [tmp_path / "runs.yaml"], **options)


def efforts(robot: Robot, seconds: float = 1.5, sensor: str = "motor") -> Log:
    """Return a log of commanded and measured efforts; behind the gear the motor's own share is missing."""
    motion = EXAMPLE["wave"](seconds)
    commands = 1.5 * np.sin(motion) + 0.5 * np.sign(np.sin(150 * motion))
    time, qpos, effort = EXAMPLE["move"](robot, "torque", commands, None)
    if sensor == "link":
        qvel = np.gradient(qpos, DT, axis=0)
        smooth = np.apply_along_axis(np.convolve, 0, qvel, np.hanning(51) / 25, "same")
        motor = EXAMPLE["MOTOR"]
        effort = effort - motor["armature"] * np.gradient(smooth, DT, axis=0)
        effort -= motor["viscous"] * smooth + motor["coulomb"] * np.tanh(smooth / 0.01)
    effort = effort + 0.02 * np.random.default_rng(0).standard_normal(effort.shape)
    return Log("log", (0,), "effort", time, qpos, time, commands, True, measured=effort, sensor=sensor)


def test_strength_and_delay_follow_from_both_efforts_without_a_model(tmp_path):
    robot = hinge(tmp_path)
    for sensor, near in (("motor", 0.01), ("link", 0.1)):
        found = measured_motors(hinge(tmp_path, 50.0), efforts(robot, 3.0, sensor), timestep=DT)  # another model
        values = dict(zip(found.names, found.estimate, strict=True))
        assert values["strength", 0] == pytest.approx(0.9, rel=near)
        assert values["delay", None] == pytest.approx(0.004, abs=1e-4 if sensor == "motor" else 1e-3)
        if sensor == "link":
            assert values["armature", 0] == pytest.approx(0.02, rel=0.2)
            assert values["friction", 0] == pytest.approx(0.15, rel=0.2)
        found.save(tmp_path / "motors.yaml", robot)
        assert bp.load_actuators(tmp_path / "motors.yaml", robot.joint_names)[0].strength[0, 0] == values["strength", 0]
    alone = replace(efforts(robot), measured=None, sensor=None)
    with pytest.raises(bp.InvalidArgumentError, match="lack efforts that are both"):
        measured_motors(robot, alone, timestep=DT)


@pytest.mark.usefixtures("short_search")
def test_a_fit_takes_strength_and_delay_from_both_efforts(tmp_path):
    robot = hinge(tmp_path)
    options = {"compensate": "none", "timestep": DT, "payload": False, "workers": 0, "evaluations": 4}
    found = identify(robot, efforts(robot), **options)
    assert ("strength", 0) in found.unknowns.names
    assert found.interval("strength", 0)[0] == pytest.approx(0.9, rel=0.01)
    assert found.interval("delay")[0] == pytest.approx(0.004, abs=2e-4)
    assert found.document()["joints"]["hinge"]["armature"][0] == pytest.approx(0.02, rel=0.05)
    assert found.actuators().command_delay[0, 0] == pytest.approx(0.004, abs=2e-4)
    assert found.held_out_error[1] < 0.1 * found.held_out_error[0]


@pytest.mark.usefixtures("short_search")
def test_measured_efforts_alone_show_a_load_and_no_delay(tmp_path):
    """The robot is 0.2 kg heavier than its file says; the error of the mass is no error of the motor's strength."""
    robot, both = hinge(tmp_path), efforts(hinge(tmp_path, 1.0), 2.0)
    log = replace(both, command=both.measured, measured=None, held=False)
    found = identify(robot, log, compensate="none", timestep=DT, workers=0, evaluations=8)
    kinds = dict(found.unknowns.names)
    assert not {"strength", "delay"} & kinds.keys()
    assert found.document()["payload"][0] == pytest.approx(0.2, abs=0.02)
    behind = identify(robot, replace(log, sensor="link"), compensate="none", timestep=DT, workers=0, evaluations=1)
    assert {*dict(behind.unknowns.names)} == {"bias", "stopping", "payload"}


def test_the_variance_is_that_of_the_mean_of_parts_that_differ():
    rng = np.random.default_rng(0)
    slopes = 2.0 + 0.3 * rng.standard_normal(8)
    tables = [np.linspace(-1, 1, 50)[:, None] for _ in slopes]
    parts = [(table.T @ table, table.T @ (slope * table[:, 0])) for table, slope in zip(tables, slopes, strict=True)]
    np.testing.assert_allclose(jackknife_variance(parts, np.zeros(1)), slopes.var(ddof=1) / len(slopes))
    assert not jackknife_variance(parts[:3], np.zeros(1)).any()
