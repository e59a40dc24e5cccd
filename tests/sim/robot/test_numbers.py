"""Every number of a URDF is read as it stands, or refused or reported with its text."""

import re

import pytest
from lxml import etree
from tiny_urdf import INERTIAL, joint, link, robot, write

from batchpid.errors import RobotError
from batchpid.sim import Robot

INNER = (
    '<limit lower="-1.25" upper="1.25" effort="10.5" velocity="2.5"/><dynamics damping="0.5"'
    ' friction="0.25"/><safety_controller soft_lower_limit="-0.75" soft_upper_limit="0.75"/>'
)
SHAPES = (
    '<box size="0.5 0.25 0.125"/>',
    '<sphere radius="0.5"/>',
    '<cylinder radius="0.5" length="0.25"/>',
)
PLACE = '<origin xyz="0.5 0.25 0.125" rpy="0.125 0.25 0.5"/>'
TURNED = '0.5 0.25 0.125" rpy="0.125 0.25 0.5'
WEIGHT = INERTIAL.replace("<mass", f"{PLACE}<mass").replace('"0"', '"0.01"').replace('"1"', '"1.5"')
WHOLE = robot(
    link("base"),
    link(
        "arm",
        WEIGHT
        + "".join(
            f"<collision>{PLACE}<geometry>{shape}</geometry></collision>" for shape in SHAPES
        ),
    ),
    link("tip"),
    joint("hinge", "base", "arm", inner=INNER, origin=TURNED).replace("0 1 0", "0.5 0 1"),
    joint(
        "follower",
        "arm",
        "tip",
        inner=INNER + '<mimic joint="hinge" multiplier="0.5" offset="0.25"/>',
    ),
)
"""Robot with the numbers that a URDF can have, most of them with decimals."""
NUMBERS = [
    (at, key)
    for at, element in enumerate(etree.fromstring(WHOLE.encode()).iter())
    for key in element.attrib
    if key not in ("name", "link", "joint", "type")
]
WRONG = (
    "{} kg",
    "x",
    "1_0",
    "nan",
    "1,234.5",
    "1,5 2",
    "1e999",
    "0x10",
    "--1",
    "1 2 3 4 5",
    "\N{MINUS SIGN}1",
)


def changed(at, key, change):
    """Return WHOLE with one of its numbers changed, and the new text."""
    root = etree.fromstring(WHOLE.encode())
    element = list(root.iter())[at]
    element.set(key, change(element.get(key)))
    return etree.tostring(root, encoding="unicode"), element.get(key)


def report(path):
    """Return the error, or the findings, of loading a robot."""
    try:
        return "\n".join(map(str, Robot.load(path).repairs))
    except RobotError as error:
        return str(error)


def test_the_robot_has_every_number_and_none_is_repaired(tmp_path):
    assert len(NUMBERS) >= 40
    assert report(write(tmp_path, WHOLE)) == ""


@pytest.mark.parametrize(("at", "key"), NUMBERS)
def test_a_number_that_cannot_be_read_is_quoted(at, key, tmp_path):
    for wrong in WRONG:
        text, written = changed(at, key, wrong.format)
        may_be_infinite = written == "1e999" and key in ("lower", "upper", "effort", "velocity")
        assert may_be_infinite or written in report(write(tmp_path, text)), written


@pytest.mark.parametrize("expression", ["$(arg x)", "$(eval 1 + 1)", "${x}"])
@pytest.mark.parametrize(("at", "key"), NUMBERS)
def test_an_expression_of_xacro_is_refused(at, key, expression, tmp_path):
    path = write(tmp_path, changed(at, key, lambda _: expression)[0])
    with pytest.raises(RobotError, match=r"is an expression of xacro.*expand it first"):
        Robot.load(path)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('lower="-1.25"', 'lower="-170"', "'hinge' .lower -170 rad"),
        ('upper="1.25"', 'upper="90"', "'hinge' .upper 90 rad"),
        ('offset="0.25"', 'offset="45"', "'follower' .mimic offset 45 rad"),
    ],
)
def test_degrees_are_recognised(old, new, said, tmp_path):
    def findings(text):
        return "\n".join(map(str, Robot.load(write(tmp_path, text)).check()))

    assert re.search(said, findings(WHOLE.replace(old, new)))
    assert "angles" not in findings(WHOLE)
