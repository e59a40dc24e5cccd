"""``batchpid export``: gains as files for other programs."""

import yaml
from tiny_urdf import LIMIT, joint, link, robot, write

from batchpid.export import to_c
from batchpid.sim import Robot

MIMIC = joint("b", "y", "z", "revolute", LIMIT + '<mimic joint="a" multiplier="0.5"/>')


def test_the_header_is_that_of_the_function(batchpid, tmp_path):
    out = tmp_path / "panda.h"
    words = [
        "export",
        "panda",
        "--gains",
        "tuned",
        "--timestep",
        "0.001",
        "--prefix",
        "arm",
        "--out",
    ]
    status, said, _ = batchpid(*words, out)
    panda = Robot.load("panda")
    exported = to_c(panda.tuned(), 0.001, joint_names=panda.joint_names, prefix="arm")
    assert (status, out.read_text()) == (0, exported.text)
    lines = [
        "panda: 9 dof",
        "The file has no differences.",
        f"written: {out}",
    ]
    assert said.splitlines() == lines


def test_followers_are_reported_and_left_out_of_controllers(batchpid, tmp_path):
    path = write(tmp_path, robot(*map(link, "xyz"), joint("a", "x", "y"), MIMIC))
    status, said, _ = batchpid("export", path, "--out", out := tmp_path / "arm.h")
    assert (status, "\ndiffers: b: followers are separate joints" in said) == (0, True)
    out = tmp_path / "controllers.yaml"
    status, said, _ = batchpid("export", path, "--to", "ros2_control", "--out", out)
    assert (status, "differs: b: followers are not in the file" in said) == (0, True)
    (controller,) = (
        each["ros__parameters"]
        for name, each in yaml.safe_load(out.read_text()).items()
        if "gains" in each.get("ros__parameters", ())
    )
    assert list(controller["gains"]) == ["a"]


def test_controllers_of_ros2_control_are_written(batchpid, tmp_path):
    out = tmp_path / "controllers.yaml"
    status, said, _ = batchpid(
        "export", "panda", "--to", "ros2_control", "--prefix", "arm", "--out", out
    )
    assert (status, said.splitlines()[-1]) == (0, f"written: {out}")
    listed = {line.split(":")[1].strip() for line in said.splitlines()[1:-1]}
    assert {"gain_units", "effort_limit"} <= listed
    assert "arm" in yaml.safe_load(out.read_text())


def test_a_repaired_urdf_is_written_with_its_changes(batchpid, tmp_path):
    path = write(
        tmp_path,
        robot(link("x"), link("y"), joint("a", "x", "y", "revolute", LIMIT.replace("-1", "3"))),
    )
    status, said, _ = batchpid("export", path, "--to", "urdf", "--out", tmp_path / "again.urdf")
    assert status == 0
    assert "\ndiffers: joint 'a' (3, 1): limits are swapped; swap them\nwritten: " in said
    assert Robot.load(tmp_path / "again.urdf", strict=True).joints == Robot.load(path).joints
    status, _, complaint = batchpid("export", path, "--to", "urdf", "--gains", "designed")
    assert (status, "gains: has no effect with --to urdf" in complaint) == (2, True)


def test_the_robot_is_written_for_mujoco(batchpid, tmp_path):
    import mujoco

    out = tmp_path / "panda.xml"
    words = ("export", "panda", "--to", "mjcf", "--timestep", 0.0005, "--force", "--out", out)
    for gains, line, stiffness in (
        ((), "The file has no differences.", 0),
        (("--gains", "designed"), "\ndiffers: ki: no integral\n", None),
        (("--gains", "drive"), "The file has no differences.", 20),
    ):
        status, said, _ = batchpid(*words, *gains)
        assert (status, line in said) == (0, True), said
        model = mujoco.MjModel.from_xml_path(str(out))
        assert (model.nq, model.nu, model.opt.timestep) == (9, 9, 0.0005)
        assert stiffness in (None, -model.actuator_biasprm[0, 1])
