"""Preflight findings: oddities of a robot, and of running it with given params from a given
pose.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from tiny_urdf import INERTIAL, LIMIT, joint, link, one_joint, robot, write

import batchpid as bp
from batchpid.sim import Finding, Robot, Runner

COLLISION = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
GAINS = {"kp": 1.0, "ki": 0.0, "kd": 0.1}

OFF_CENTRE = INERTIAL.replace("<inertial>", '<inertial><origin xyz="0 0 1"/>')


def codes(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.code: finding for finding in findings}


@pytest.mark.parametrize(
    ("text", "code", "severity", "message"),
    [
        (
            one_joint(arm=COLLISION),
            "no-inertia",
            "warning",
            "link 'arm' .1 kg.: no <inertial>.*collision shapes, at 1000",
        ),
        (one_joint(arm=""), "no-inertia", "warning", "link 'arm': .*1e-6 kg that carries"),
        (
            robot(link("b"), link("m", ""), link("a"), joint("h", "b", "m"), joint("k", "m", "a")),
            "no-inertia",
            "note",
            "link 'm': .*1e-6 kg; only the links that it carries have mass",
        ),
        (
            one_joint(arm=INERTIAL.replace('mass value="1"', 'mass value="0"')),
            "no-inertia",
            "warning",
            "'arm'",
        ),
        (
            one_joint(LIMIT + '<dynamics friction="12"/>'),
            "friction",
            "warning",
            "'hinge' .12 N m, limit 10.: friction.*no motion",
        ),
        (one_joint("", "continuous"), "continuous", "note", "'hinge': position wraps"),
        (
            one_joint('<limit lower="0.5" upper="0.5" effort="1" velocity="1"/>'),
            "no-range",
            "warning",
            r"'hinge' .\[0.5, 0.5\].: .*no motion",
        ),
        (
            one_joint('<limit lower="-1" upper="1"/>'),
            "no-effort-limit",
            "note",
            "'hinge' .3 N m.: no effort limit",
        ),
        (
            one_joint(LIMIT.replace('"1"', '"inf"')),
            "no-limits",
            "note",
            "'hinge': no position limits",
        ),
        (
            one_joint(arm=INERTIAL.replace('izz="0.1"', 'izz="0.3"')),
            "inertia",
            "note",
            "'arm' .by 33 %.: no body has.*as given",
        ),
    ],
)
def test_each_oddity_of_a_urdf_has_its_finding(text, code, severity, message, tmp_path):
    findings = codes(Robot.load(write(tmp_path, text)).check())
    assert code in findings
    assert findings[code].severity == severity
    assert re.search(message, str(findings[code])), str(findings[code])
    assert findings[code].remedy


def test_links_without_mass_are_reported_where_they_are_bodies(tmp_path):
    parts = link("a", ""), link("tip", ""), joint("h", "b", "a"), joint("f", "a", "tip", "fixed")
    light = write(tmp_path, robot(link("b"), *parts), "light.urdf")
    assert [
        finding.link for finding in Robot.load(light).check() if finding.code == "no-inertia"
    ] == ["a"]
    heavy = write(tmp_path, light.read_text().replace(link("tip", ""), link("tip")), "heavy.urdf")
    assert Robot.load(heavy).check() == []
    assert "carries nothing" in str(Robot.load(light).check())


def test_a_sound_robot_has_no_findings(tmp_path, panda):
    assert Robot.load(write(tmp_path, one_joint())).check() == []
    for params in (panda.tuned(), *map(panda.designed, ("effort", "mass_matrix"))):
        assert panda.check(params=params, setpoint=panda.settings.target) == []


def test_poses_beyond_limits_are_reported_by_joint(panda):
    findings = panda.check(qpos=np.zeros(9), setpoint=np.ones(9))
    outside = [finding for finding in findings if finding.code == "out-of-limits"]
    assert [finding.joint for finding in outside if "start pose" in finding.text] == [
        "panda_joint4"
    ]
    assert {f.joint for f in findings if "setpoint" in f.text} == {
        "panda_joint4",
        "panda_finger_joint1",
        "panda_finger_joint2",
    }


def test_links_that_overlap_at_the_start_are_reported(tmp_path):
    box = INERTIAL + COLLISION
    text = robot(
        link("b"), link("l", box), link("r", box), joint("j", "b", "l"), joint("k", "b", "r")
    )
    assert "touching" not in codes(Robot.load(write(tmp_path, text)).check())
    assert "touching" in codes(Robot.load(write(tmp_path, text), self_collision="urdf").check())
    apart = text.replace('xyz="0 0 1"', 'xyz="0 1 1"', 1)
    assert "touching" not in codes(Robot.load(write(tmp_path, apart)).check())


def test_params_that_disagree_with_the_urdf_on_continuous_joints_are_reported(tmp_path):
    wheel = Robot.load(write(tmp_path, one_joint("", "continuous")))
    plain = bp.make_params(1, **GAINS)
    assert [
        finding.severity for finding in wheel.check(params=plain) if finding.code == "continuous"
    ] == [
        "warning",
        "note",
    ]
    assert codes(wheel.check(params=wheel.params(**GAINS)))["continuous"].severity == "note"
    hinge = Robot.load(write(tmp_path, one_joint()))
    wrapped = bp.make_params(1, **GAINS, continuous=[True])
    assert "short way round" in codes(hinge.check(params=wrapped))["continuous"].text
    assert "continuous" not in codes(hinge.check(params=hinge.params(**GAINS)))


def test_the_most_severe_findings_come_first(jaco2):
    severities = [finding.severity for finding in jaco2.check(setpoint=np.full(13, 9.0))]
    assert severities == sorted(severities, key=("warning", "note").index)


# -- Stability
# --------------------------------------------------------------------------------------------------


def test_the_tutorials_gains_are_unstable_on_the_jaco2s_light_links(jaco2):
    (found,) = (finding for finding in jaco2.check() if finding.code == "unstable")
    assert re.search(
        r"times its stability bound, mostly of joint 'j2s7s300_joint_finger_tip_\d'", found.text
    )
    slower = [
        finding.code for finding in jaco2.check(params=jaco2.params(kp=0.01, ki=0.0, kd=1e-5))
    ]
    assert "unstable" not in slower


def test_gains_that_ring_are_found_with_frequency_and_damping(panda):
    """The tutorial's gains on the panda: the simulated motion has the reported period and decay."""
    (found,) = (
        finding for finding in panda.check(params=panda.params()) if finding.code == "ringing"
    )
    assert (found.severity, found.joint) == ("note", "panda_joint2")
    assert "rings at 0.54 Hz with a damping ratio of 0.068" in found.text
    assert "65 % of the amplitude" in found.text
    target = panda.start + np.where(np.arange(9) == 1, 0.1, 0.0)
    with Runner(
        panda, 1, workers=0, params=panda.params(), collisions=False, substeps=20
    ) as runner:
        rollout = runner.rollout(np.broadcast_to(target, (500, 9)))
    error = rollout.qpos[:, 0, 1] - target[1]
    peaks = 1 + np.flatnonzero(
        (error[1:-1] > error[:-2]) & (error[1:-1] >= error[2:]) & (error[1:-1] > 0.01)
    )
    assert len(peaks) >= 2
    assert rollout.time[peaks[1]] - rollout.time[peaks[0]] == pytest.approx(1 / 0.54, rel=0.05)
    assert error[peaks[1]] / error[peaks[0]] == pytest.approx(0.65, abs=0.05)


def test_an_effort_limit_below_gravity_is_found(tmp_path):
    text = one_joint('<limit lower="-1.5" upper="1.5" effort="4" velocity="2"/>', arm=OFF_CENTRE)
    findings = {finding.code: finding for finding in Robot.load(write(tmp_path, text)).check()}
    assert findings["weak"].joint == "hinge"
    assert findings["weak"].severity == "warning"
    assert "gravity up to 9.7" in findings["weak"].detail
    strong = Robot.load(write(tmp_path, text.replace('effort="4"', 'effort="10"'), "strong.urdf"))
    assert "weak" not in {finding.code for finding in strong.check()}


def test_friction_counts_with_gravity(tmp_path):
    text = one_joint(
        '<limit lower="-1.5" upper="1.5" effort="10" velocity="2"/><dynamics friction="2"/>',
        arm=OFF_CENTRE,
    )
    (finding,) = (each for each in Robot.load(write(tmp_path, text)).check() if each.code == "weak")
    assert "friction 2" in finding.detail
