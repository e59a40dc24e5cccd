"""Diagnosis of a fit: a link that is heavier than described, weak motors, and a push."""

from __future__ import annotations

import re

import numpy as np
import pytest

import batchpid as bp
from batchpid.sim import Robot, Runner, write_recording
from batchpid.sim.identification import excite, identify
from batchpid.sim.identification.diagnosis import diagnose
from batchpid.sim.identification.fit_search import likely_drives
from batchpid.sim.identification.inputs import read_inputs
from batchpid.sim.identification.regression import smooth
from batchpid.sim.robot.urdf_export import to_urdf
from tests.sim.tuning.identification.test_identify import ARM

pytest.importorskip("scipy")
pytest.importorskip("mujoco.batch")
SECONDS, TICK = 5.0, 5
PUSH = 3.0


def six_joints() -> str:
    """Return the URDF of an arm of six joints, j0 to j5."""
    parts = ['<robot name="arm6"><link name="l0"/>']
    sizes = [(4, 0.2, 150), (5, 0.4, 150), (3, 0.35, 100), (1.5, 0.1, 30), (1.2, 0.1, 30), (0.5, 0.08, 15)]
    above = 0.1
    for number, (mass, length, effort) in enumerate(sizes):
        axis = "0 0 1" if number in (0, 4) else "0 1 0"
        across = mass * (length**2 / 12 + 0.002)
        tensor = f'ixx="{across}" iyy="{across}" izz="{0.003 * mass}" ixy="0" ixz="0" iyz="0"'
        inertial = f'<origin xyz="0.01 0 {length / 2}"/><mass value="{mass}"/><inertia {tensor}/>'
        ends = f'<parent link="l{number}"/><child link="l{number + 1}"/><origin xyz="0 0 {above}"/><axis xyz="{axis}"/>'
        limit = f'<limit lower="-2.5" upper="2.5" effort="{effort}" velocity="4"/>'
        parts.append(f'<link name="l{number + 1}"><inertial>{inertial}</inertial></link>')
        parts.append(f'<joint name="j{number}" type="revolute">{ends}{limit}</joint>')
        above = length
    return "".join([*parts, "</robot>"])


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """Return the robot as described, and with a fore link of 1.2 times the mass and inertia."""
    folder = tmp_path_factory.mktemp("arms")
    heavy = ARM.replace('<mass value="1"/>', '<mass value="1.2"/>')
    heavy = heavy.replace('ixx="0.01"', 'ixx="0.012"').replace('iyy="0.01"', 'iyy="0.012"')
    heavy = heavy.replace('izz="0.002"', 'izz="0.0024"')
    for name, text in (("described", ARM), ("heavy", heavy)):
        (folder / f"{name}.urdf").write_text(text)
    return {name: Robot.load(folder / f"{name}.urdf") for name in ("described", "heavy")}


def diagnosed(arms, folder, real, *, push=0.0, **motors):
    """Return the diagnosis of a log of the ``real`` robot, with a push at PUSH seconds that it does not hold."""
    robot, path = arms["described"], folder / "log.h5"
    inertia = np.diagonal(robot.mass_matrix(robot.start)[0])
    motors = {"command_delay": 0.003, "coulomb": 0.4, "viscous": 0.3 * inertia} | motors
    motors = bp.make_actuators(robot.dof, **motors)
    gains = bp.design_gains(robot, 1.2, derivative_filter_time=2e-3).replace(setpoint_weight=1.0)
    motion = excite(robot, SECONDS, lowest=0.3, rate=2000 / TICK)
    pushes = np.zeros((len(motion.position), 1, robot.dof))
    pushes[round(PUSH * 2000 / TICK) :, 0, 1][: round(0.2 * 2000 / TICK)] = push
    options = {"workers": 0, "substeps": TICK, "compensate": "none", "actuators": motors, "engine": "mujoco"}
    with Runner(arms[real], 1, params=gains, collisions=False, ground=False, **options) as runner:
        runner.reset(motion.position[0])
        write_recording(runner.rollout(motion.position, feedforwards=pushes), path, overwrite=True)
    inputs = read_inputs(robot, [path], gains, "none", 1 / 2000, 1, False)
    motions = [smooth(log, inputs.drive.timestep) for log in inputs.logs]
    _, regression = likely_drives(inputs.robot, inputs.joints, inputs.drive, inputs.logs, motions, False)[0]
    return diagnose(regression, inputs.logs, list(robot.joint_names)), gains, path


def test_a_heavier_link_is_named(arms, tmp_path):
    found, *_ = diagnosed(arms, tmp_path, "heavy")
    assert list(found.links) == ["fore"]
    assert found.links["fore"] == pytest.approx(1.2, rel=0.02)
    described, free = found.explained
    assert described < 0.96 < free
    assert found.strengths is None
    assert re.search(r"link fore seems (19|20|21) % heavier", " ".join(found.sentences()))


def test_a_joint_that_sticks_does_not_hide_a_heavier_link(tmp_path):
    (tmp_path / "six.urdf").write_text(six_joints())
    robot = Robot.load(tmp_path / "six.urdf")
    (tmp_path / "heavy.urdf").write_text(to_urdf(robot, mass_factors={"l3": 1.3}).text)
    arms = {"described": robot, "heavy": Robot.load(tmp_path / "heavy.urdf")}
    found = diagnosed(arms, tmp_path, "heavy", coulomb=0.003 * robot.design_effort_limit)[0]
    assert found.links == pytest.approx({"l3": 1.3}, rel=0.05)


@pytest.mark.slow
def test_the_result_of_a_fit_has_the_diagnosis_and_corrects_the_urdf(arms, tmp_path):
    diagnosis, gains, path = diagnosed(arms, tmp_path, "heavy")
    found = identify(arms["described"], [path], params=gains, payload=False, evaluations=1, workers=0)
    assert found.diagnosis.links == pytest.approx(diagnosis.links)
    assert found.document()["diagnosis"]["mass_factors"] == found.diagnosis.links
    corrected = tmp_path / "corrected.urdf"
    corrected.write_text(found.corrected_urdf())
    own, other = Robot.load(corrected), arms["heavy"]
    np.testing.assert_allclose(own.mass_matrix(own.start), other.mass_matrix(other.start), rtol=0.02)


def test_weak_motors_are_no_heavy_links(arms, tmp_path):
    found, *_ = diagnosed(arms, tmp_path, "described", strength=[1.0, 0.8])
    assert found.links == {}
    assert found.disturbance is None


def test_where_all_motors_are_weak_both_are_said(arms, tmp_path):
    found, *_ = diagnosed(arms, tmp_path, "described", strength=0.8)
    assert found.strengths == pytest.approx([0.8, 0.8], rel=0.05)
    assert [*found.links.values()] == pytest.approx([1.25, 1.25], rel=0.05)
    assert any("do not tell which" in each for each in found.sentences())


def test_a_push_is_pointed_at(arms, tmp_path):
    found, *_ = diagnosed(arms, tmp_path, "described", push=6.0)
    assert found.disturbance.time == pytest.approx(PUSH + 0.1, abs=0.25)
    assert found.disturbance.joint == "elbow"
    assert found.disturbance.effort == pytest.approx(6.0, rel=0.5)
    assert found.disturbance.log.endswith("log.h5")
    assert any(each.startswith(("at 3.", "at 2.9")) for each in found.sentences())
