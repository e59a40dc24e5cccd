"""Faults of published URDFs that are repaired."""

from tiny_urdf import INERTIAL, LIMIT, joint, link, one_joint, robot

BASE, ARM, TIP = link("base"), link("arm"), link("tip")


HINGE = joint("hinge", "base", "arm")


SHAPE = "<collision><geometry>{}</geometry></collision>"


TENSOR = (
    '<inertial><mass value="2"/><inertia ixx="{}" ixy="{}" ixz="{}" iyy="{}" iyz="{}"'
    ' izz="{}"/></inertial>'
)


def moved(mimic, kind="revolute"):
    """Two joints in a row, the second with a ``<mimic>``."""
    return robot(BASE, ARM, TIP, HINGE, joint("tip_joint", "arm", "tip", kind, LIMIT + mimic))


def limited(**attributes):
    return one_joint(
        "<limit {}/>".format(" ".join(f'{key}="{value}"' for key, value in attributes.items()))
    )


def mass(value):
    return one_joint(arm=INERTIAL.replace('mass value="1"', f'mass value="{value}"'))


def shaped(shape):
    return one_joint(arm=INERTIAL + SHAPE.format(shape))


REPAIRED = {  # the URDF, the code of its finding, and what that says
    "blank before the declaration": (
        "\n" + one_joint(),
        "xml",
        "robot: not well-formed XML.*line 2",
    ),
    "comment before the declaration": (
        "<!-- made by hand -->" + one_joint(),
        "xml",
        "XML declaration",
    ),
    "wrong encoding": (one_joint().replace("?>", " encoding='utf-16'?>"), "xml", "not well-formed"),
    "hyphens in a comment": (robot(BASE, ARM, HINGE, "<!-- a -- b -->"), "xml", "hyphen"),
    "several roots": (one_joint() + "<gazebo/>", "xml", "Extra content"),
    "ampersand": (one_joint().replace('"test"', '"rock & roll"'), "xml", "EntityRef"),
    "undeclared prefix": (
        robot(BASE, ARM, HINGE, "<xacro:macro/>"),
        "xml",
        "left out: 1 <xacro:macro>; expand",
    ),
    "link twice": (
        robot(BASE, ARM, ARM, HINGE),
        "repeated",
        "link 'arm': .*repeated one: left",
    ),
    "joint twice": (robot(BASE, ARM, HINGE, HINGE), "repeated", "'hinge': given twice"),
    "joint name twice": (
        robot(BASE, ARM, TIP, HINGE, joint("hinge", "arm", "tip")),
        "repeated",
        "one: renamed 'hinge_2'",
    ),
    "joint without name": (
        one_joint().replace('name="hinge"', ""),
        "repeated",
        "renamed 'base_to_arm'",
    ),
    "unknown link": (robot(BASE, HINGE), "loose-link", "link 'arm': .*added"),
    "loose link": (robot(BASE, ARM, TIP, HINGE), "loose-link", "link 'tip': no joint holds"),
    "unknown type": (
        robot(BASE, ARM, TIP, HINGE, joint("k", "arm", "tip", "ball")),
        "joint",
        "joint 'k': joints of type 'ball'.*: fixed",
    ),
    "planar": (
        robot(BASE, ARM, TIP, HINGE, joint("k", "arm", "tip", "planar")),
        "joint",
        "'planar'.*: fixed",
    ),
    "floating base": (
        robot(link("pedestal"), BASE, ARM, HINGE, joint("k", "pedestal", "base", "floating")),
        "joint",
        "'k': .*'floating'.*: fixed instead; load with fixed_base=False",
    ),
    "zero axis": (
        one_joint().replace("0 1 0", "0 0 0"),
        "joint",
        "'hinge': .*no direction: the x axis",
    ),
    "axis of two numbers": (one_joint().replace("0 1 0", "0 1"), "joint", "'hinge': .*x axis"),
    "two limits": (
        one_joint(LIMIT + LIMIT),
        "repeated",
        "'hinge': <joint> has several <limit>: the first is used",
    ),
    "no limit": (one_joint(""), "limits", "'hinge': no position limits"),
    "no range": (limited(effort="1", velocity="1"), "limits", "'hinge': no position limits"),
    "NaN limit": (
        limited(lower="nan", upper="1"),
        "limits",
        "'hinge': <limit lower='nan'> is not a number",
    ),
    "limit of 1e300": (
        limited(lower="0", upper="1e300"),
        "limits",
        "'hinge': <limit upper='1e300'> is not a number within",
    ),
    "swapped limits": (
        limited(lower="2", upper="1"),
        "limits",
        r"'hinge' \(2, 1\): limits are swapped",
    ),
    "effort of 0": (
        one_joint(LIMIT.replace('"10"', '"0"')),
        "limits",
        "'hinge': .*effort='0'.*placeholder",
    ),
    "velocity of 0": (
        one_joint(LIMIT.replace('"2"', '"0"')),
        "limits",
        "'hinge': .*placeholder",
    ),
    "digits of another script": (
        one_joint(LIMIT.replace('"10"', '"1_0"')),
        "limits",
        "'1_0'> is a placeholder",
    ),
    "negative effort": (
        one_joint(LIMIT.replace('"10"', '"-9"')),
        "limits",
        "'hinge': .*'-9'> is a placeholder",
    ),
    "negative damping": (
        one_joint(LIMIT + '<dynamics damping="-1"/>'),
        "dynamics",
        "'hinge': .*damping='-1'.*0 is used",
    ),
    "infinite friction": (
        one_joint(LIMIT + '<dynamics friction="inf"/>'),
        "dynamics",
        "'hinge': .*friction='inf'",
    ),
    "mimic of nothing": (
        moved('<mimic joint="ghost"/>'),
        "mimic",
        "'tip_joint': .*'ghost'.*not in the file.*independ",
    ),
    "mimic without joint": (moved('<mimic multiplier="2"/>'), "mimic", "'tip_joint': mimics None"),
    "mimic by 0": (
        moved('<mimic joint="hinge" multiplier="0"/>'),
        "mimic",
        "'tip_joint': .*multiplier '0'",
    ),
    "mimic by nothing": (
        moved('<mimic joint="hinge" offset="x"/>'),
        "mimic",
        "'tip_joint': .*offset 'x'",
    ),
    "mimic of a fixed joint": (
        robot(
            BASE,
            ARM,
            TIP,
            joint("f", "base", "arm", "fixed", ""),
            joint("k", "arm", "tip", inner=LIMIT + '<mimic joint="f"/>'),
        ),
        "mimic",
        "'k': mimics 'f', which does not move",
    ),
    "fixed joint that mimics": (
        moved('<mimic joint="hinge"/>', "fixed"),
        "mimic",
        "'tip_joint': .*cannot move a fixed joint",
    ),
    "mimics in a circle": (
        moved('<mimic joint="hinge"/>').replace(
            "</joint>", '<mimic joint="tip_joint"/></joint>', 1
        ),
        "mimic",
        "'hinge': mimics 'tip_joint', which mimics it in turn",
    ),
    "negative mass": (
        mass("-1"),
        "inertia",
        "link 'arm': <mass value='-1'> is no mass from",
    ),
    "NaN mass": (mass("nan"), "inertia", "link 'arm': <mass value='nan'>"),
    "mass of 1e300": (mass("1e300"), "inertia", "link 'arm': <mass value='1e300'>"),
    "mass of 1e-300": (mass("1e-300"), "inertia", "link 'arm': <mass value='1e-300'>"),
    "centre of mass": (
        one_joint(arm=INERTIAL.replace("<mass", '<origin xyz="1e300 0 0"/><mass')),
        "inertia",
        "link 'arm': <origin xyz='1e300 0 0'> needs 3 finite numbers.*: the centre of mass",
    ),
    "no inertia": (
        one_joint(arm='<inertial><mass value="2"/></inertial>'),
        "inertia",
        "'arm' .*ball of its mass",
    ),
    "zero inertia": (
        one_joint(arm=TENSOR.format(*"000000")),
        "inertia",
        "'arm' .*0 0 0 .*ball of its mass",
    ),
    "one entry everywhere": (
        one_joint(arm=TENSOR.format(*["1e-6"] * 6)),
        "inertia",
        "1e-06 1e-06 2e-06.*nearest",
    ),
    "rounded zero": (
        one_joint(arm=TENSOR.format("0.2", "0", "0", "0.2", "0", "0.0")),
        "inertia",
        "0.0002 0.2 0.2",
    ),
    "large off-diagonal": (
        one_joint(arm=TENSOR.format("0.1", "1", "0", "0.1", "0", "0.1")),
        "inertia",
        "'arm'.*near",
    ),
    "negative moment": (
        one_joint(arm=TENSOR.format("-1", "0", "0", "1", "0", "1")),
        "inertia",
        "'arm'.*nearest",
    ),
    "shape without geometry": (
        one_joint(arm=INERTIAL + "<collision/>"),
        "collision",
        "'arm': .*none of box",
    ),
    "unknown shape": (shaped("<plane/>"), "collision", "'arm': .*none of box"),
    "two shapes": (
        shaped('<sphere radius="1"/><box size="1 1 1"/>'),
        "repeated",
        "link 'arm': <geometry> has several shapes",
    ),
    "negative box": (
        shaped('<box size="-1 1 1"/>'),
        "collision",
        "'arm': a collision shape is left out: <box size='-1",
    ),
    "flat box": (
        shaped('<box size="1 1 0"/>'),
        "collision",
        "'arm': a collision shape is left out: <box size",
    ),
    "NaN sphere": (shaped('<sphere radius="nan"/>'), "collision", "'arm': .*<sphere radius='nan'>"),
    "scale of 0": (
        shaped('<mesh filename="x.stl" scale="0 1 1"/>'),
        "collision",
        "'arm': .*<mesh scale='0 1 1'>",
    ),
    "shape nowhere": (
        one_joint(
            arm=INERTIAL
            + SHAPE.format('<box size="1 1 1"/>').replace("<geo", '<origin xyz="x"/><geo')
        ),
        "collision",
        "'arm': a collision shape is left out: <origin xyz='x'> needs 3",
    ),
    "missing mesh": (
        shaped('<mesh filename="package://ghost/no.stl"/>'),
        "missing-mesh",
        "package://ghost/no.stl",
    ),
}
