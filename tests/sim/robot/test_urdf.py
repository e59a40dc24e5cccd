"""Every fault of a URDF has its error, with culprit and remedy; none runs, hangs or crashes."""

import re
from itertools import pairwise

import numpy as np
import pytest
from tiny_urdf import INERTIAL, joint, link, one_joint, robot, write

from batchpid.errors import RobotError, RobotNotFoundError
from batchpid.sim import Robot, Runner, to_mjcf

BASE, ARM, TIP = link("base"), link("arm"), link("tip")
HINGE = joint("hinge", "base", "arm")

BAD = {
    "malformed": ("<robot name='x'><link", "not well-formed XML.*correct the file"),
    "empty": ("", "not well-formed XML"),
    "another format": ("<sdf/>", "root element is <sdf>, not <robot>"),
    "NaN origin": (
        robot(BASE, ARM, joint("hinge", "base", "arm", origin="0 nan 0")),
        "joint 'hinge'.*origin.*finite",
    ),
    "origin of two numbers": (
        robot(BASE, ARM, joint("hinge", "base", "arm", origin="0 1")),
        "joint 'hinge'.*origin.*3 finite numbers",
    ),
    "loop": (
        robot(BASE, ARM, link("c"), HINGE, joint("b", "arm", "c"), joint("a", "c", "arm")),
        "two parents: arm",
    ),
    "loop apart": (
        robot(BASE, ARM, link("c"), link("d"), HINGE, joint("b", "c", "d"), joint("a", "d", "c")),
        "loop apart from the root",
    ),
    "two robots": (
        robot(BASE, ARM, link("other"), link("leg"), HINGE, joint("k", "other", "leg")),
        "one root.*other",
    ),
    "misspelt link": (
        robot(BASE, ARM, TIP, joint("hinge", "base", "amr"), joint("k", "arm", "tip")),
        r"one root link.*joints name, not in the file: \['amr'\]",
    ),
    "xacro": (
        robot(BASE, ARM, joint("${side}_hinge", "base", "arm")),
        r"'\$\{side\}_hinge'> is .*xacro.*expand it",
    ),
    "too much": (robot(*map(link, map(str, range(4097))), HINGE), "more than 4096 links or joints"),
    "all in a loop": (
        robot(BASE, ARM, HINGE, joint("back", "arm", "base")),
        "exactly one root.*a loop",
    ),
    "no parent": (one_joint().replace('<parent link="base"/>', ""), "joint 'hinge'.*needs <parent"),
    "no joint": (robot(BASE), "without joints.*xacro, expand it first"),
    "library of xacro": (
        robot(
            '<xacro:macro xmlns:xacro="http://wiki.ros.org/xacro" name="arm">',
            BASE,
            ARM,
            HINGE,
            "</xacro:macro>",
        ),
        "xacro, expand it first",
    ),
    "fixed joints only": (one_joint("", "fixed"), "without moving joints"),
    "no link": (robot(), "exactly one root|without"),
}

UNHOLDABLE = {  # by single precision or by PhysX
    "origin": (
        one_joint().replace('xyz="0 0 1"', 'xyz="0 0 1e300"'),
        "joint 'hinge'.*origin xyz='0 0 1e300'",
    ),
    "angle": (
        one_joint().replace('xyz="0 0 1"', 'rpy="0 0 1e300"'),
        "joint 'hinge'.*origin rpy='0 0 1e300'",
    ),
}
BAD |= {f"{name} that PhysX cannot hold": case for name, case in UNHOLDABLE.items()}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_urdf_has_its_error(case, tmp_path):
    text, message = BAD[case]
    path = write(tmp_path, text)
    with pytest.raises(RobotError) as info:
        Robot.load(path)
    assert re.search(message, str(info.value), re.DOTALL), str(info.value)
    assert str(path) in str(info.value)


def test_a_missing_file_and_an_unknown_name_are_not_found(tmp_path):
    with pytest.raises(RobotNotFoundError, match=f"^{tmp_path} is a folder; pass the path"):
        Robot.load(tmp_path)
    with pytest.raises(
        RobotNotFoundError, match=r"no robot 'pandaa'.*jaco2, panda.*check the spelling"
    ):
        Robot.load("pandaa")
    for path in ("/no/such.urdf", "~nobody-at-all/arm.urdf", "x" * 1000, "x" * 5000):
        with pytest.raises(FileNotFoundError, match=path):
            Robot.load(path)


def test_the_limit_of_links_is_that_of_one_engine(tmp_path):
    chain = (link(f"l{n + 1}") + joint(f"j{n}", f"l{n}", f"l{n + 1}") for n in range(299))
    long = Robot.load(write(tmp_path, robot(link("l0"), *chain)))
    options = {"control": "effort", "workers": 0, "substeps": 1, "ground": False}
    with Runner(long, 1, engine="mujoco", compensate="none", **options) as runner:
        assert runner.step(np.zeros(299)).ok.all()
    assert long.check(engine="mujoco") == long.check()
    (finding,) = set(long.check(engine="sapien")) - set(long.check())
    for refused in (finding.text, "300 links that move; PhysX holds at most 255.*use the engine"):
        with pytest.raises(RobotError, match=refused):
            Runner(long, 1, engine="sapien", **options)


BOMB = "<!DOCTYPE robot [<!ENTITY a0 'ha'>{}]>".format(
    "".join(f"<!ENTITY a{n} '{f'&a{n - 1};' * 10}'>" for n in range(1, 12))
)
HOSTILE = {
    "entities in text": robot(BASE, ARM, HINGE, "<x>&a11;</x>", head=BOMB),
    "entities in an attribute": robot(BASE, ARM, HINGE, '<x y="&a11;"/>', head=BOMB),
    "external entity": robot(
        BASE,
        ARM,
        HINGE,
        "<x>&f;</x>",
        head="<!DOCTYPE robot [<!ENTITY f SYSTEM 'file:///etc/passwd'>]>",
    ),
    "external DTD": robot(
        BASE, ARM, HINGE, head="<!DOCTYPE robot SYSTEM 'http://127.0.0.1:9/x.dtd'>"
    ),
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
    include = (
        '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="/etc/passwd" parse="text"/>'
    )
    loaded = Robot.load(write(tmp_path, robot(BASE, ARM, HINGE, include)))
    assert [finding.code for finding in loaded.repairs] == ["unknown-element"]


def test_building_writes_no_file(tmp_path, monkeypatch):
    """A killed worker leaves no file behind, and a full disk stops none."""
    text = one_joint().replace("hinge", "Ellbogengelenk für die Übung")
    path = write(tmp_path, text)
    write(tmp_path, '<robot name="x"/>', "test.srdf")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    named = Robot.load(path)
    assert named.joint_names == ("Ellbogengelenk für die Übung",)
    with Runner(named, 1, workers=0, params=named.params(kp=1.0), ground=False):
        pass


@pytest.mark.parametrize(
    "head", ['<?xml version="1.0"?>', "\n<!-- made by hand --><?xml version='1.0'?>"]
)
def test_a_default_namespace_is_ignored(head, tmp_path):
    plain = one_joint(arm=INERTIAL + '<visual><geometry><box size="1 1 1"/></geometry></visual>')
    named = plain.replace('<?xml version="1.0"?>', head).replace(
        "<robot", '<robot xmlns="http://www.ros.org"'
    )
    robots = [
        Robot.load(write(tmp_path, text, f"{at}.urdf")) for at, text in enumerate((plain, named))
    ]
    assert robots[0].tables == robots[1].tables


def test_a_robot_without_a_name_is_called_after_its_file(tmp_path):
    loaded = Robot.load(write(tmp_path, one_joint().replace(' name="test"', ""), "arm.urdf"))
    assert loaded.name == "arm"


def test_a_joint_gets_a_name_that_no_other_has(tmp_path):
    unnamed = HINGE.replace('name="hinge"', "")
    loaded = Robot.load(
        write(tmp_path, robot(BASE, ARM, TIP, unnamed, joint("base_to_arm", "arm", "tip")))
    )
    assert loaded.joint_names == ("base_to_arm_2", "base_to_arm")


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_links_may_have_the_names_of_added_bodies(engine, tmp_path):
    """MuJoCo's root is called world; where links of a body collide in part, each gets a body "LINK
    (shapes)".
    """
    box = INERTIAL + '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
    names = ["world", "world_link", "world_link_2", "a", "b", "a (shapes)", "a (shapes)_2"]
    joints = [
        joint(f"to {b}", a, b, "fixed" if b == "b" else "revolute") for a, b in pairwise(names)
    ]
    path = write(tmp_path, robot(*(link(name, box) for name in names), *joints))
    write(
        tmp_path,
        '<robot><disable_collisions link1="a" link2="world" reason="x"/></robot>',
        "test.srdf",
    )
    loaded = Robot.load(path)
    with Runner(loaded, 1, workers=0, engine=engine, params=loaded.params(kp=1.0)) as runner:
        assert runner.step(loaded.start).ok.all()
    if engine == "mujoco":
        text = to_mjcf(loaded, loaded.designed("effort"), 1e-3).text
        assert 'name="world_link_3"' in text
        assert 'name="a (shapes)_3"' in text
