"""Preflight findings: oddities of a robot, and of running it with given params from a given pose."""

import re

import numpy as np
import pytest
import trimesh
from faulty_urdfs import REPAIRED
from robots import load_bundled
from test_unsettled import CASES as RUNS
from tiny_urdf import INERTIAL, LIMIT, joint, link, one_joint, robot, write

from batchpid.sim import Robot
from batchpid.sim.findings import FINDING_KINDS, SEVERITIES

BOX = '<collision><geometry><box size="{0} {0} {0}"/></geometry></collision>'
COLLISION = BOX.format(0.1)
GAINS = {"kp": 1.0, "ki": 0.0, "kd": 0.1}
OFF_CENTRE = INERTIAL.replace("<inertial>", '<inertial><origin xyz="0 0 1"/>')
BESIDE = robot(
    link("b"),
    link("l", INERTIAL + COLLISION),
    link("r", INERTIAL + COLLISION),
    joint("j", "b", "l"),
    joint("k", "b", "r"),
)
"""Two links at the same place."""


def mjcf(inner='<joint name="j"/>', rest=""):
    body = f'<body name="b"><geom size=".1"/>{inner}</body>'
    return f"<mujoco><worldbody>{body}</worldbody>{rest}</mujoco>"


ODDITIES = {
    # a file, options of loading and of the check, the code of its finding, and what that says
    "an actuator with a filter": (
        mjcf(rest='<actuator><position joint="j" timeconst=".1"/></actuator>'),
        {},
        "actuator",
        "joint 'j': .*has effects that are not simulated",
    ),
    "other gravity": (mjcf(rest='<option gravity="0 0 0"/>'), {}, "option", "gravity is"),
    "a closed loop": (
        mjcf(rest='<equality><weld body1="b"/></equality>'),
        {"engine": "sapien"},
        "engine",
        "equality",
    ),
    "unknown elements": (
        robot(link("base"), link("arm"), joint("hinge", "base", "arm"), "<plugin/><plugin/>"),
        {},
        "unknown-element",
        "note: .*left out: 2 <plugin>",
    ),
    "a mesh that is not convex": (
        one_joint(
            arm=INERTIAL
            + BOX.format(0.1).replace('box size="0.1 0.1 0.1"', 'mesh filename="u.stl"')
        ),
        {},
        "collision",
        r"'arm' \(1.34 times its volume\): .*not convex",
    ),
    "shapes in millimetres": (
        one_joint(arm=INERTIAL + BOX.format(100)),
        {},
        "units",
        r"link 'arm' \(shapes of 173 m; .* 1 m long\): sizes .*millimetres",
    ),
    "tiny shapes": (
        one_joint(arm=INERTIAL + BOX.format(1e-3)),
        {},
        "units",
        r"at most 0.0017 m.* 1 m long\): sizes",
    ),
    "degrees": (
        one_joint(LIMIT.replace('"-1"', '"-90"')),
        {},
        "units",
        "'hinge' .lower -90 rad.: .*degrees as radians",
    ),
    "a moment above the sum of the others": (
        one_joint(arm=INERTIAL.replace('izz="0.1"', 'izz="0.3"')),
        {},
        "inertia",
        "'arm' .by 33 %.: no body has.*as given",
    ),
    "the mass of shapes": (
        one_joint(arm=COLLISION),
        {},
        "no-inertia",
        "link 'arm' .1 kg.: no <inertial>.*collision shapes",
    ),
    "no mass": (one_joint(arm=""), {}, "no-inertia", "link 'arm' .1e-6 kg."),
    "a mass of 0": (
        one_joint(arm=INERTIAL.replace('mass value="1"', 'mass value="0"')),
        {},
        "no-inertia",
        "'arm'.* with a mass of 0",
    ),
    "links that overlap": (
        BESIDE,
        {"self_collision": "urdf"},
        "touching",
        "start pose: . on .",
    ),
    "friction": (
        one_joint(LIMIT + '<dynamics friction="12"/>'),
        {},
        "effort-limit",
        "'hinge' .10 N m, .* friction 12, 100 % of poses",
    ),
    "gravity": (
        one_joint(LIMIT.replace('"10"', '"4"'), arm=OFF_CENTRE),
        {},
        "effort-limit",
        "'hinge' .4 N m, gravity up to 8.",
    ),
    "gravity with friction": (
        one_joint(LIMIT.replace('"1"', '"1.5"') + '<dynamics friction="2"/>', arm=OFF_CENTRE),
        {},
        "effort-limit",
        "gravity up to 9..*friction 2, ",
    ),
    "no effort limit": (
        one_joint('<limit lower="-1" upper="1"/>'),
        {},
        "no-effort-limit",
        "note: joint 'hinge' .3 N m.: no effort limit",
    ),
    "an .srdf with other links": (
        one_joint(),
        {"srdf": robot('<disable_collisions link1="arm" link2="l7"/>')},
        "self-collision",
        "link2='l7'",
    ),
}


def codes(findings):
    return {finding.code: finding for finding in findings}


@pytest.mark.parametrize("name", ODDITIES)
def test_each_oddity_of_a_file_has_its_finding(name, tmp_path):
    text, options, code, message = ODDITIES[name]
    srdf = options.get("srdf")
    if srdf is not None:
        write(tmp_path, srdf, "test.srdf")
    suffix = "xml" if text.startswith("<mujoco") else "urdf"
    path = write(tmp_path, text, f"test.{suffix}")
    notch = [trimesh.creation.box(size) for size in ([3, 1, 1], [1, 1, 3], [1, 1, 3])]
    for part, place in zip(notch[1:], ([-1, 0, 2.01], [1, 0, 2.01]), strict=True):
        part.apply_translation(place)
    trimesh.util.concatenate(notch).export(tmp_path / "u.stl")
    loading = {key: value for key, value in options.items() if key == "self_collision"}
    checked = Robot.load(path, **loading).check(engine=options.get("engine"))
    findings = [each for each in checked if each.code == code]
    assert re.search(message, str(findings[0])), findings
    assert all(each.remedy for each in findings)


def test_every_kind_of_finding_has_a_case():
    """In these tables, and for params and setpoints in the tests below and beside it."""
    cases = {code for _, code, _ in REPAIRED.values()} | {case.code for case in RUNS.values()}
    cases |= {code for _, _, code, _ in ODDITIES.values()}
    assert cases | {"missing-mesh", "unstable"} == set(FINDING_KINDS)
    assert {kind.severity for kind in FINDING_KINDS.values()} == set(SEVERITIES)
    assert len(FINDING_KINDS) <= 30


def test_links_without_mass_are_reported_where_they_are_bodies(tmp_path):
    parts = link("a", ""), link("tip", ""), joint("h", "b", "a"), joint("f", "a", "tip", "fixed")
    light = write(tmp_path, robot(link("b"), *parts), "light.urdf")
    assert [
        finding.link for finding in Robot.load(light).check() if finding.code == "no-inertia"
    ] == ["a"]
    heavy = write(tmp_path, light.read_text().replace(link("tip", ""), link("tip")), "heavy.urdf")
    assert Robot.load(heavy).check() == []


def test_a_sound_robot_has_no_findings(tmp_path, panda):
    assert Robot.load(write(tmp_path, one_joint())).check() == []
    for params in (panda.tuned(), *map(panda.designed, ("effort", "mass_matrix"))):
        assert panda.check(params=params, setpoint=panda.settings.target) == []


def test_poses_beyond_limits_are_reported_by_joint(panda):
    findings = panda.check(qpos=np.zeros(9), setpoint=np.ones(9))
    outside = [finding for finding in findings if finding.code == "out-of-limits"]
    assert [finding.joint for finding in outside if "start pose" in finding.detail] == [
        "panda_joint4"
    ]
    assert {f.joint for f in findings if "setpoint" in f.detail} == {
        "panda_joint4",
        "panda_finger_joint1",
        "panda_finger_joint2",
    }


def test_links_that_overlap_by_design_or_are_apart_do_not_touch(tmp_path):
    assert "touching" not in codes(Robot.load(write(tmp_path, BESIDE)).check())
    apart = BESIDE.replace('xyz="0 0 1"', 'xyz="0 1 1"', 1)
    loaded = Robot.load(write(tmp_path, apart), self_collision="urdf")
    assert "touching" not in codes(loaded.check())


def test_the_most_severe_findings_come_first(jaco2):
    severities = [finding.severity for finding in jaco2.check(setpoint=np.full(13, 9.0))]
    assert severities == sorted(severities, key=("warning", "note").index)


def test_the_tutorials_gains_are_unstable_on_the_jaco2s_light_links(jaco2):
    unstable = codes(jaco2.check())["unstable"]
    assert unstable.joint.startswith("j2s7s300_joint_finger_tip_")
    assert "times the bound at the start pose: efforts alternate" in unstable.detail
    slower = jaco2.check(params=jaco2.params(kp=0.01, ki=0.0, kd=1e-5))
    assert "unstable" not in codes(slower)


@pytest.mark.parametrize("name", Robot.bundled())
def test_bundled_robots_have_the_units_of_robots(name):
    assert not {"units", "no-inertia"} & codes(load_bundled(name).check()).keys()
