"""Every fault of a URDF has its error, with culprit and remedy; none runs, hangs or crashes."""

from __future__ import annotations

import random
import re

import numpy as np
import pytest
from tiny_urdf import INERTIAL, LIMIT, joint, link, one_joint, robot, write

from batchpid.errors import BatchPIDError, RobotError, RobotNotFoundError
from sim import Robot, Runner

BASE, ARM = link("base"), link("arm")
HINGE = joint("hinge", "base", "arm")
MESH = '<collision><geometry><mesh filename="{}"/></geometry></collision>'

BAD = {
    "malformed": ("<robot name='x'><link", "not well-formed XML.*correct the file"),
    "empty": ("", "not well-formed XML"),
    "another format": ("<sdf/>", "root element is <sdf>, not <robot>"),
    "no limit": (one_joint(""), "joint 'hinge'.*needs <limit"),
    "prismatic without limit": (one_joint("", "prismatic"), "joint 'hinge'.*needs <limit"),
    "unknown type": (one_joint(LIMIT, "ball"), "joint 'hinge'.*type 'ball'.*use revolute"),
    "floating": (one_joint("", "floating"), "joint 'hinge'.*type 'floating'"),
    "planar": (one_joint("", "planar"), "joint 'hinge'.*type 'planar'"),
    "NaN limit": (one_joint(LIMIT.replace('"-1"', '"nan"')), "joint 'hinge'.*limit is NaN.*give numbers"),
    "NaN effort": (one_joint(LIMIT.replace('"10"', '"nan"')), "joint 'hinge'.*limit is NaN"),
    "swapped limits": (one_joint(LIMIT.replace('"-1"', '"2"')), "'hinge'.*lower limit 2 is above.*swap them"),
    "negative effort": (one_joint(LIMIT.replace('"10"', '"-1"')), "'hinge'.*must be >= 0.*correct"),
    "no number": (one_joint(LIMIT.replace('"10"', '"ten"')), "'hinge'.*effort='ten'.*not a number"),
    "negative damping": (one_joint(LIMIT + '<dynamics damping="-1"/>'), "'hinge'.*damping and friction"),
    "infinite friction": (one_joint(LIMIT + '<dynamics friction="inf"/>'), "'hinge'.*damping and friction"),
    "negative mass": (one_joint(arm=INERTIAL.replace('"1"', '"-1"')), "link 'arm'.*mass -1"),
    "negative inertia": (one_joint(arm=INERTIAL.replace('ixx="0.1"', 'ixx="-0.1"')), "link 'arm'.*inertia"),
    "inertia no matrix can have": (
        one_joint(arm=INERTIAL.replace('ixy="0"', 'ixy="1"')),
        "link 'arm'.*inertia",
    ),
    "NaN mass": (one_joint(arm=INERTIAL.replace('"1"', '"nan"')), "link 'arm'.*mass nan"),
    "NaN origin": (
        robot(BASE, ARM, joint("hinge", "base", "arm", origin="0 nan 0")),
        "joint 'hinge'.*origin.*finite",
    ),
    "origin of two numbers": (
        robot(BASE, ARM, joint("hinge", "base", "arm", origin="0 1")),
        "joint 'hinge'.*origin.*3 finite numbers",
    ),
    "zero axis": (one_joint().replace('axis xyz="0 1 0"', 'axis xyz="0 0 0"'), "joint 'hinge'.*axis"),
    "loop": (
        robot(BASE, ARM, link("c"), HINGE, joint("b", "arm", "c"), joint("a", "c", "arm")),
        "two parents: arm",
    ),
    "loop apart": (
        robot(BASE, ARM, link("c"), link("d"), HINGE, joint("b", "c", "d"), joint("a", "d", "c")),
        "loop apart from the root",
    ),
    "all in a loop": (robot(BASE, ARM, HINGE, joint("back", "arm", "base")), "exactly one root.*a loop"),
    "two roots": (robot(BASE, ARM, link("other"), HINGE), "exactly one root link, found.*other"),
    "link twice": (robot(BASE, ARM, ARM, HINGE), "link name used twice: arm"),
    "joint twice": (
        robot(BASE, ARM, link("c"), HINGE, joint("hinge", "arm", "c")),
        "joint name used twice: hinge",
    ),
    "unknown link": (robot(BASE, HINGE), "joint 'hinge' names the unknown link 'arm'"),
    "no parent": (one_joint().replace('<parent link="base"/>', ""), "joint 'hinge'.*needs <parent"),
    "mimic of nothing": (
        one_joint(LIMIT + '<mimic joint="ghost"/>'),
        "'hinge' mimics the unknown joint 'ghost'",
    ),
    "no joint": (robot(BASE), "without moving joints"),
    "fixed joints only": (one_joint("", "fixed"), "without moving joints"),
    "no link": (robot(), "exactly one root|without"),
    "missing mesh": (
        one_joint(arm=INERTIAL + MESH.format("no.stl")),
        "collision mesh not found: no.stl.*package_dirs",
    ),
    "missing package": (
        one_joint(arm=INERTIAL + MESH.format("package://ghost/no.stl")),
        "collision mesh not found: package://ghost/no.stl",
    ),
    "negative box": (
        one_joint(arm=INERTIAL + '<collision><geometry><box size="-1 1 1"/></geometry></collision>'),
        "link 'arm'.*box",
    ),
    "NaN sphere": (
        one_joint(arm=INERTIAL + '<collision><geometry><sphere radius="nan"/></geometry></collision>'),
        "link 'arm'.*sphere",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_urdf_has_its_error(case, tmp_path):
    text, message = BAD[case]
    path = write(tmp_path, text)
    with pytest.raises(RobotError) as info:
        Robot.load(path)
    assert re.search(message, str(info.value), re.DOTALL), str(info.value)
    assert str(path) in str(info.value)


def test_a_missing_file_and_an_unknown_name_are_not_found():
    with pytest.raises(RobotNotFoundError, match=r"no robot 'pandaa'.*jaco2, panda.*check the spelling"):
        Robot.load("pandaa")
    for path in ("/no/such.urdf", "~nobody-at-all/arm.urdf", "x" * 1000):
        with pytest.raises(FileNotFoundError, match=path):
            Robot.load(path)


def test_a_binary_file_is_refused(tmp_path):
    path = tmp_path / "test.urdf"
    path.write_bytes(bytes(range(256)) * 10)
    with pytest.raises(RobotError, match="not well-formed"):
        Robot.load(path)


BOMB = "<!DOCTYPE robot [<!ENTITY a0 'ha'>{}]>".format(
    "".join(f"<!ENTITY a{n} '{f'&a{n - 1};' * 10}'>" for n in range(1, 12))
)
HOSTILE = {
    "entities in text": robot(BASE, ARM, HINGE, "<x>&a11;</x>", head=BOMB),
    "entities in an attribute": robot(BASE, ARM, HINGE, '<x y="&a11;"/>', head=BOMB),
    "external entity": robot(
        BASE, ARM, HINGE, "<x>&f;</x>", head="<!DOCTYPE robot [<!ENTITY f SYSTEM 'file:///etc/passwd'>]>"
    ),
    "external DTD": robot(BASE, ARM, HINGE, head="<!DOCTYPE robot SYSTEM 'http://127.0.0.1:9/x.dtd'>"),
    "parameter entity": robot(
        BASE, ARM, HINGE, head="<!DOCTYPE robot [<!ENTITY % p SYSTEM 'file:///etc/passwd'> %p;]>"
    ),
    "deep nesting": robot(BASE, ARM, HINGE, "<x>" * 100_000 + "</x>" * 100_000),
}


@pytest.mark.parametrize("case", HOSTILE)
@pytest.mark.timeout(20)
def test_hostile_xml_is_refused(case, tmp_path):
    path = write(tmp_path, HOSTILE[case])
    with pytest.raises(RobotError, match=r"DTD or entity|not well-formed") as info:
        Robot.load(path)
    assert "root:" not in str(info.value)
    path = write(tmp_path, one_joint())
    write(tmp_path, HOSTILE[case].replace("<robot ", "<robot x='' "), "test.srdf")
    with pytest.raises(RobotError, match=r"test\.srdf.*(DTD or entity|not well-formed)"):
        Robot.load(path)


def test_an_xinclude_is_not_followed(tmp_path):
    include = '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="/etc/passwd" parse="text"/>'
    loaded = Robot.load(write(tmp_path, robot(BASE, ARM, HINGE, include)))
    assert "root:" not in loaded.urdf


def test_joints_are_in_the_order_of_sapien(tmp_path):
    random_tree = random.Random(0)
    for _ in range(5):
        links, joints = ["l0"], []
        for number in range(1, 14):
            kind = random_tree.choice(["revolute", "prismatic", "continuous", "fixed"])
            joints.append(joint(f"j{number}", random_tree.choice(links), f"l{number}", kind))
            links.append(f"l{number}")
        random_tree.shuffle(joints)
        tree = Robot.load(write(tmp_path, robot(*map(link, links), *joints)))
        with Runner(tree, 1, workers=0, params=tree.params(kp=1.0), ground=False):
            pass  # building the scene compares the orders


@pytest.mark.parametrize(
    ("multiplier", "offset", "works"), [(1, 0, True), (-1, 0, True), (2, 0, False), (1, 0.1, False)]
)
def test_a_mimic_is_kept_only_where_sapien_simulates_it_correctly(multiplier, offset, works, tmp_path):
    mimic = f'<mimic joint="left" multiplier="{multiplier}" offset="{offset}"/>'
    hand = Robot.load(
        write(
            tmp_path,
            robot(
                BASE,
                link("l"),
                link("r"),
                joint("left", "base", "l", origin="0 1 1"),
                joint("right", "base", "r", inner=LIMIT + mimic, origin="0 -1 1"),
            ),
        )
    )
    assert ("<mimic" in hand.urdf) == works
    assert {finding.code: finding.severity for finding in hand.check()}["mimic"] == ("note" if works else "warning")
    with Runner(hand, 1, workers=0, params=hand.params(kp=20.0, kd=3.0), ground=False) as runner:
        for _ in range(100):
            qpos = runner.step([0.5, 0.0]).qpos[0]
    if works:
        assert abs(qpos[1] - multiplier * qpos[0]) < 0.01
        assert abs(qpos[0]) > 0.1
    else:
        np.testing.assert_allclose(qpos, [0.5, 0.0], atol=0.02)


def test_links_tied_by_fixed_joints_do_not_push_each_other(tmp_path):
    """A hand overlaps the arm beyond its flange: the engine would find contact there at every step."""
    box = INERTIAL + '<collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision>'
    parts = [link("base"), link("arm", box), link("flange"), link("hand", box), link("finger", box)]
    chain = [
        HINGE,
        joint("mount", "arm", "flange", "fixed", "", "0 0 0.1"),
        joint("grip", "flange", "hand", "fixed", "", "0 0 0"),
        joint("close", "hand", "finger", origin="0 0 0.25"),
    ]
    arm = Robot.load(write(tmp_path, robot(*parts, *chain)))
    with Runner(arm, 1, workers=0, control="effort", substeps=400, ground=False) as runner:
        runner.reset(np.array([0.3, 0.0]))
        still = runner.step(np.zeros(2))
    np.testing.assert_allclose(still.qpos, [[0.3, 0.0]], atol=1e-5)
    assert arm.dynamics().in_contact(np.array([[0.3, 0.0]])).tolist() == [False]


def test_building_writes_no_file(tmp_path, monkeypatch):
    """A killed worker leaves no file behind, and a full disk stops none."""
    text = one_joint().replace("hinge", "Ellbogengelenk für die Übung")
    path = write(tmp_path, text)
    write(tmp_path, '<robot name="x"/>', "test.srdf")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    named = Robot.load(path)
    assert named.joint_names == ("Ellbogengelenk für die Übung",)
    assert named.srdf is not None
    with Runner(named, 1, workers=0, params=named.params(kp=1.0), ground=False):
        pass


def test_missing_meshes_can_be_skipped(tmp_path):
    path = write(tmp_path, one_joint(arm=INERTIAL + MESH.format("no.stl")))
    loaded = Robot.load(path, missing_meshes="skip")
    assert loaded.missing_meshes == ("no.stl",)
    assert "missing-mesh" in {finding.code for finding in loaded.check()}


@pytest.mark.parametrize(
    "options",
    [
        {"name_or_path": 3},
        {"name_or_path": None},
        {"name_or_path": b"panda"},
        {"name_or_path": "panda\0"},
        {"name_or_path": ""},
        {"name_or_path": "panda", "package_dirs": "folder"},
        {"name_or_path": "panda", "missing_meshes": "ignore"},
        {"name_or_path": "panda", "dissipation": None},
        {"name_or_path": "panda", "package_dirs": 3},
        {"name_or_path": "panda", "package_dirs": [None]},
        {"name_or_path": "panda", "fixed_base": "yes"},
    ],
)
def test_invalid_options_of_load_raise(options):
    with pytest.raises(BatchPIDError):
        Robot.load(**options)
