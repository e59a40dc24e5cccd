"""Collision meshes that cannot be read, or that claim more than there is, are found at load."""

import os
import struct

import numpy as np
import pytest
from mesh_files import GOOD, arm, dae, glb, obj, stl
from tiny_urdf import INERTIAL, one_joint, write

from batchpid.errors import RobotError
from batchpid.sim import Robot, Runner
from batchpid.sim.robot.robot_options import describe

LFS = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"
CLAIM = 4_000_000_000
BAD = {
    f"{kind} {name}": (name, data)
    for name in GOOD
    for kind, data in {"git-lfs": LFS, "empty": b""}.items()
}
BAD |= {
    f"{share} of {name}": (name, data[: int(len(data) * share)])
    for name, data in GOOD.items()
    for share in (0.1, 0.5)
}
BAD |= {f"all but the end of {name}": (name, GOOD[name][:-20]) for name in GOOD if name != "d.obj"}
BAD |= {
    "STL that claims 200 GB": ("a.stl", stl()[:80] + struct.pack("<I", CLAIM) + stl()[84:]),
    "STL without triangles": ("a.stl", bytes(84)),
    "STL with a NaN": ("a.stl", stl()[:96] + struct.pack("<f", np.nan) + stl()[100:]),
    "OBJ without faces": ("d.obj", obj().split(b"\nf")[0]),
    "OBJ with a NaN": ("d.obj", obj().replace(b"1.0", b"nan")),
    "OBJ with a face of vertices that it lacks": ("d.obj", obj().replace(b"f 1 3 2", b"f 1 3 9")),
    "STL named OBJ": ("d.obj", stl()),
    "DAE without geometry": ("e.dae", dae().replace(b"library_geometries", b"library_nothings")),
    "GLB of 20 bytes that claims 4 GB": (
        "f.glb",
        struct.pack("<4sIIII", b"glTF", 2, CLAIM, CLAIM - 20, 0x4E4F534A),
    ),
    "GLB of 20 bytes with a JSON of 4 GB": (
        "f.glb",
        struct.pack("<4sIIII", b"glTF", 2, 20, CLAIM, 0x4E4F534A),
    ),
    "GLB without meshes": ("f.glb", glb(meshes=[])),
    "GLB with another file": ("f.glb", glb(buffers=[{"byteLength": 96, "uri": "/dev/zero"}])),
    "other format": ("g.ply", b"ply\n"),
    "no format": ("mesh", stl()),
}


@pytest.mark.parametrize("name", GOOD)
def test_a_sound_mesh_is_simulated(name, tmp_path):
    (tmp_path / name).write_bytes(GOOD[name])
    loaded = Robot.load(write(tmp_path, arm(name)))
    assert loaded.repairs == ()
    touching = loaded.dynamics().in_contact(
        np.array([[0.0], [np.pi]]), clearance=0.01
    )  # above the ground, and on it
    assert touching.tolist() == [False, True]


@pytest.mark.parametrize(
    "name",
    [
        "package://arm_description/meshes/arm.stl",
        "package:///arm_description/meshes/arm.stl",
        "package://arm_of_the_maker/meshes/arm.stl",
        "model://arm_description/meshes/arm.stl",
        "$(find arm_description)/meshes/arm.stl",
        "../meshes/arm.stl",
        "..\\meshes\\arm.stl",
        "meshes/arm.stl",
        "file://{folder}/meshes/arm.stl",
        "file://localhost{folder}/meshes/arm.stl",
        "file:{folder}/meshes/arm.stl",
        "file://$(find arm_description)/meshes/arm.stl",
        "package://arm_description/meshes/%61rm.stl",
        "package://arm_description/meshes/arm.STL",
        "meshes/arm.Stl",
        "{folder}/meshes/arm.stl",
    ],
)
def test_a_mesh_is_found_by_the_ways_that_urdfs_name_it(name, tmp_path):
    folder = tmp_path / "arm_description"
    for each in ("urdf", "meshes"):
        (folder / each).mkdir(parents=True)
    (folder / "meshes" / "arm.stl").write_bytes(stl())
    loaded = Robot.load(write(folder / "urdf", arm(name.format(folder=folder))), strict=True)
    (shape,) = loaded.tables.shapes
    assert shape.file.replace("urdf/../", "") == str(folder / "meshes" / "arm.stl")


@pytest.mark.parametrize(
    ("variable", "path", "package"),
    [
        ("AMENT_PREFIX_PATH", "{0}/none:{0}/install", "install/share/arm_description"),
        ("ROS_PACKAGE_PATH", "{0}/none:{0}/ws/src", "ws/src/arm_description"),
        ("ROS_PACKAGE_PATH", "{0}/ws/src/arm_description", "ws/src/arm_description"),
    ],
)
def test_packages_of_a_ros_environment_are_found(variable, path, package, tmp_path, monkeypatch):
    file, elsewhere = tmp_path / package / "meshes" / "my arm.STL", tmp_path / "elsewhere"
    file.parent.mkdir(parents=True)
    elsewhere.mkdir()
    file.write_bytes(stl())
    urdf = write(elsewhere, arm("package://arm_description/meshes/my%20arm.stl"))
    with pytest.raises(RobotError, match=r"my%20arm\.stl.* package_dirs=.* ROS_PACKAGE_PATH"):
        Robot.load(urdf, strict=True)
    monkeypatch.setenv(variable, path.format(tmp_path))
    assert [shape.file for shape in Robot.load(urdf, strict=True).tables.shapes] == [str(file)]


@pytest.mark.parametrize("case", BAD)
def test_an_unreadable_mesh_is_skipped_and_reported(case, tmp_path):
    name, data = BAD[case]
    (tmp_path / name).write_bytes(data)
    path = write(tmp_path, arm(name))
    loaded = Robot.load(path)
    (finding,) = (each for each in loaded.check() if each.code == "missing-mesh")
    assert f"without: {name} (" in finding.text
    with Runner(loaded, 1, workers=0, params=loaded.params(kp=1.0)) as runner:
        assert runner.step([0.0]).ok.all()


def test_a_mesh_too_large_to_be_read_is_refused_without_reading_it_all(tmp_path):
    (path := tmp_path / "large.stl").touch()
    os.truncate(path, 2**40)
    with pytest.raises(RobotError, match="larger than"):
        Robot.load(write(tmp_path, arm("large.stl")), strict=True)


def test_a_mesh_that_only_the_engine_refuses_is_an_error_of_the_runner(tmp_path):
    (tmp_path / "odd.obj").write_bytes(obj().replace(b"1.0", b"1e-7"))
    loaded = Robot.load(write(tmp_path, arm("odd.obj")))
    with pytest.raises(RobotError, match=r"link 'arm'.*collision shape from .*odd\.obj"):
        Runner(loaded, 1, engine="sapien", workers=0, params=loaded.params(kp=1.0))


def test_another_digit_of_any_file_is_another_robot(tmp_path):
    """Whatever this process keeps of the files: size and time stamp stay."""
    (tmp_path / "d.obj").write_bytes(obj())
    path = write(tmp_path, arm("d.obj"))
    first = describe(Robot.load(path))
    for file in (path, tmp_path / "d.obj"):
        text, stamp = file.read_text(), file.stat().st_mtime_ns
        # The version of the XML changes nothing.
        digits = [at for at, letter in enumerate(text) if letter in "12" and at > 20]
        for at in digits[:: max(1, len(digits) // 6)]:
            file.write_text(text[:at] + {"1": "2", "2": "1"}[text[at]] + text[at + 1 :])
            os.utime(file, ns=(stamp, stamp))
            # A mesh may be none any more, and is left out.
            assert describe(Robot.load(path)) != first, text[at - 9 : at + 9]
        file.write_text(text)
    assert describe(Robot.load(path)) == first


def test_a_mesh_that_changed_since_it_was_loaded_is_refused(tmp_path):
    (tmp_path / "d.obj").write_bytes(obj())
    path = write(tmp_path, arm("d.obj"))
    robot = Robot.load(path)
    (tmp_path / "d.obj").write_bytes(obj().replace(b"1.0", b"0.9"))
    for engine in ("sapien", "mujoco"):
        with pytest.raises(RobotError, match=r"d\.obj: has changed since the robot was loaded"):
            Runner(robot, 1, workers=0, engine=engine, control="effort")
        Runner(Robot.load(path), 1, workers=0, engine=engine, control="effort").close()


def test_robots_of_other_content_differ_in_what_they_say_about_themselves(tmp_path):
    arm = INERTIAL + '<collision><geometry><mesh filename="m.stl"/></geometry></collision>'
    (tmp_path / "m.stl").write_bytes(stl())
    path = write(tmp_path, one_joint(arm=arm))
    first = Robot.load(path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/m.stl").write_bytes(stl())
    moved = Robot.load(write(tmp_path / "other", one_joint(arm=arm)))
    assert describe(moved) == describe(first), "equal but for the folder"
    for name, value in (("fixed_base", False), ("self_collision", "none")):
        assert describe(Robot.load(path, **{name: value}))[name] == value != describe(first)[name]
