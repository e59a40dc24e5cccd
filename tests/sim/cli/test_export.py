"""``batchpid export``: gains as files for other programs."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_urdf import INERTIAL, LIMIT, joint, link, robot, write

import batchpid as bp
from batchpid.export import to_c, to_c_project
from batchpid.sim import Robot
from batchpid.sim.tuning import gain_set

MIMIC = joint("b", "y", "z", "revolute", LIMIT + '<mimic joint="a" multiplier="0.5"/>')


def test_the_header_is_that_of_the_function(batchpid, tmp_path):
    out = tmp_path / "panda.h"
    words = ("export", "panda", "--gains", "tuned", "--timestep", 0.001, "--limits", "--prefix", "arm", "--out", out)
    status, said, _ = batchpid(*words)
    panda = Robot.load("panda")
    exported = to_c(panda.tuned(), 0.001, joint_names=panda.joint_names, guard=panda.guard(), prefix="arm")
    assert (status, out.read_text()) == (0, exported.text)
    assert said == f"written: {out}: tuned gains of 9 joints at 1000 Hz\n"


def test_a_project_is_written_beside_the_header(batchpid, tmp_path):
    out = tmp_path / "arm.h"
    words = ("export", "panda", "--gains", "tuned", "--dynamics", "--project", "--out", out)
    assert batchpid(*words)[0] == 0
    panda = Robot.load("panda")
    options = {"joint_names": panda.joint_names, "tree": panda.kinematic_tree()}
    files = to_c_project(panda.tuned(), 0.001, header="arm.h", **options)
    assert {each.name: each.read_text() for each in tmp_path.iterdir()} == files
    out.unlink()
    status, _, complaint = batchpid(*words)
    assert (status, "CMakeLists.txt" in complaint, out.exists()) == (2, True, False)


def test_followers_are_reported_and_refused_with_strict(batchpid, tmp_path):
    names = ("x", "y", "z")
    path = write(
        tmp_path, robot(*(link(name, INERTIAL) for name in names), joint("a", "x", "y", "revolute", LIMIT), MIMIC)
    )
    status, said, _ = batchpid("export", path, "--out", tmp_path / "arm.h")
    assert status == 0
    assert said.startswith("differs: b: followers are joints of their own")
    assert (tmp_path / "arm.h").read_text().startswith("/* differs: b: followers are joints of their own")
    status, _, complaint = batchpid("export", path, "--out", tmp_path / "strict.h", "--strict")
    assert status == 2
    assert "followers" in complaint
    assert not (tmp_path / "strict.h").exists()


@pytest.mark.filterwarnings("default:.*effort_limit")
def test_controllers_of_ros2_control_are_written_and_read(batchpid, tmp_path):
    out = tmp_path / "controllers.yaml"
    status, said, _ = batchpid("export", "panda", "--to", "ros2_control", "--prefix", "arm", "--limits", "--out", out)
    assert (status, said.splitlines()[-1]) == (0, f"written: {out}: tuned gains of 9 joints at 1000 Hz")
    listed = {line.split(":")[1].strip() for line in said.splitlines()[:-1]}
    assert {"gain_units", "guard", "effort_limit"} <= listed
    assert all(f"# {line}\n" in out.read_text() for line in said.splitlines()[:-1])
    panda = Robot.load("panda")
    with pytest.warns(UserWarning, match="effort_limit"):
        params = gain_set(panda, str(out)).params
    inertia = np.diagonal(panda.mass_matrix(panda.start)[0])
    np.testing.assert_allclose(params.kp[0], panda.tuned().kp[0] * inertia, rtol=1e-12)
    status, said, _ = batchpid("rollout", "panda", "--gains", out, "--seconds", 0.01, "--workers", 0, "--num-envs", 1)
    assert status == 0


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_gains_of_other_programs_are_compared(batchpid, tmp_path):
    path = write(tmp_path, robot(link("x"), link("y"), joint("a", "x", "y", "revolute", LIMIT)))
    out = tmp_path / "controllers.yaml"
    assert batchpid("export", path, "--to", "ros2_control", "--out", out)[0] == 0
    words = ("--moves", 1, "--seconds", 0.05, "--workers", 0)
    status, said, _ = batchpid("compare", path, "--gains", "designed", out, *words)
    assert status == 0
    assert all(name in said for name in ("designed", "controllers.yaml"))


def test_followers_are_left_out_of_controllers_and_read_from_their_leaders(batchpid, tmp_path):
    names = ("x", "y", "z")
    path = write(
        tmp_path, robot(*(link(name, INERTIAL) for name in names), joint("a", "x", "y", "revolute", LIMIT), MIMIC)
    )
    out = tmp_path / "controllers.yaml"
    status, said, _ = batchpid("export", path, "--to", "ros2_control", "--out", out)
    assert status == 0
    assert "differs: b: followers are not in the file" in said
    pair = Robot.load(path)
    with pytest.warns(UserWarning, match="effort_limit"):
        params = gain_set(pair, str(out)).params
    assert params.num_joints == 2
    assert params.kp[0, 0] == params.kp[0, 1] > 0


def test_a_repaired_urdf_is_written_with_its_changes(batchpid, tmp_path):
    path = write(tmp_path, robot(link("x"), link("y"), joint("a", "x", "y", "revolute", LIMIT.replace("-1", "3"))))
    status, said, _ = batchpid("export", path, "--to", "urdf", "--out", tmp_path / "again.urdf")
    assert status == 0
    assert said.startswith("differs: joint 'a' (3, 1): limits are swapped; swap them\nwritten: ")
    assert "<!-- differs: joint 'a' (3, 1): limits are swapped; swap them -->" in (tmp_path / "again.urdf").read_text()
    assert Robot.load(tmp_path / "again.urdf", strict=True).joints == Robot.load(path).joints
    status, _, complaint = batchpid("export", path, "--to", "urdf", "--out", tmp_path / "b.urdf", "--strict")
    assert (status, "swapped" in complaint) == (2, True)
    status, _, complaint = batchpid("export", path, "--to", "urdf", "--gains", "designed")
    assert (status, "gains: has no effect with --to urdf" in complaint) == (2, True)


def test_pd_targets_have_the_motors_and_the_friction_of_the_robot(batchpid, tmp_path):
    rubs = '<dynamics friction="0.25" damping="0.5"/>'
    path = write(tmp_path, robot(link("x"), link("y"), joint("a", "x", "y", "revolute", LIMIT + rubs)))
    bp.save_actuators(tmp_path / "motors.yaml", bp.make_actuators(1, command_delay=0.002, coulomb=0.5), ["a"])
    out, words = tmp_path / "arm.py", ("--actuators", tmp_path / "motors.yaml", "--force")
    status, said, _ = batchpid("export", path, "--to", "isaac_lab", "--out", out, *words)
    assert (status, "differs: ki: no integral" in said) == (0, True)
    text = out.read_text()
    expected = ("DelayedPDActuatorCfg(", "dynamic_friction=0.75", "viscous_friction=0.5", "min_delay=2", "_limit=10.0")
    assert all(each in text for each in expected)
    status, said, _ = batchpid("export", path, "--to", "maniskill", "--out", out, *words)
    assert (status, "differs: coulomb: friction of PhysX is a coefficient" in said) == (0, True)
    assert "force_limit=[10.0]" in out.read_text()
    status, said, _ = batchpid("export", path, "--to", "newton", "--out", out, *words)
    assert (status, "differs: command_delay: of the setpoint" in said) == (0, True)
    assert all(each in out.read_text() for each in ("DrivePID", "'delay_steps': 2", "'joint_friction': {'a': 0.75}"))
    assert batchpid("export", path, "--out", tmp_path / "a.h", *words)[0] == 2


def test_the_robot_is_written_for_mujoco(batchpid, tmp_path):
    mujoco = pytest.importorskip("mujoco", "3.17")
    out = tmp_path / "panda.xml"
    words = ("--gains", "designed", "--timestep", 0.0005, "--limits", "--out", out)
    status, said, _ = batchpid("export", "panda", "--to", "mjcf", *words)
    assert (status, "differs: guard" in said) == (0, True)
    assert "<!-- differs: guard" in out.read_text()
    model = mujoco.MjModel.from_xml_path(str(out))
    assert (model.nq, model.nu, model.opt.timestep) == (9, 27, 0.0005)
    status, said, _ = batchpid("export", "panda", "--to", "mjcf", "--motors", "--force", "--out", out)
    assert (status, said.splitlines()[-1]) == (0, f"written: {out}: motors of 9 joints")
    assert mujoco.MjModel.from_xml_path(str(out)).nu == 9
    assert (
        batchpid("export", "panda", "--to", "mjcf", "--motors", "--gains", "designed", "--out", out, "--force")[0] == 2
    )
