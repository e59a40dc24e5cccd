"""Faults of published URDFs that are repaired: each is reported, refused by strict=True, and the
robot runs.
"""

import re
import warnings

import numpy as np
import pytest
from faulty_urdfs import ARM, HINGE, REPAIRED
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_urdf import INERTIAL, LIMIT, joint, link, one_joint, robot, write

from batchpid.errors import RobotError
from batchpid.sim import RepairWarning, Robot
from batchpid.sim.description.merging import link_inertias
from batchpid.sim.geometry.shapes import ball, nearest_physical, triangle_excess


@pytest.mark.parametrize("case", REPAIRED)
def test_a_repair_is_told_and_the_robot_runs_or_strict_refuses(case, tmp_path):
    text, code, message = REPAIRED[case]
    path = write(tmp_path, text)
    with pytest.warns(
        RepairWarning, match=r"repairs?; robot.check\(\) and batchpid inspect list them"
    ) as warned:
        repaired = Robot.load(path)
    assert [f": {len(repaired.repairs)} repair" in str(each.message) for each in warned] == [True]
    told = [str(finding) for finding in repaired.repairs if finding.code == code]
    assert any(re.search(message, each) for each in told), repaired.repairs
    engine, pose = repaired.dynamics(ground=False), repaired.start[None]
    assert engine.in_contact(pose).shape == (1,)  # builds the scene and steps it
    assert np.isfinite(engine.forward_dynamics(pose, 0 * pose, 0 * pose)).all()
    with pytest.raises(RobotError, match="which strict=True refuses") as info:
        Robot.load(path, strict=True)
    assert re.search(message.split(";")[0], str(info.value))


def test_repairs_have_the_effect_that_they_tell(tmp_path):
    def load(case):
        return Robot.load(write(tmp_path, REPAIRED[case][0]))

    assert (load("swapped limits").lower, load("swapped limits").upper) == (1, 2)
    assert load("effort of 0").effort_limit == load("velocity of 0").velocity_limit == np.inf
    assert load("joint name twice").joint_names == ("hinge", "hinge_2")
    assert [joint.mimic for joint in load("mimics in a circle").joints].count(None) == 1
    assert load("floating base").joint_names == ("hinge",)
    assert {"limits", "no-effort-limit"} <= {
        finding.code for finding in load("effort of 0").check()
    }
    heavy = load("no inertia").mass_matrix([0.0])[0]
    np.testing.assert_allclose(heavy, ball(2.0)[:1, :1], rtol=1e-4)


def test_commas_count_as_blanks_and_nothing_as_the_default(tmp_path):
    text = one_joint(LIMIT.replace('"10"', '""')).replace("0 1 0", "0, 1, 0")
    loaded = Robot.load(write(tmp_path, text), strict=True)
    assert loaded.joints[0].axis == (0, 1, 0)
    assert loaded.effort_limit == np.inf


def test_latin_1_that_claims_to_be_utf_8_is_read(tmp_path):
    path = tmp_path / "test.urdf"
    path.write_bytes(one_joint().replace("hinge", "Drehgelenk für Rück").encode("latin-1"))
    assert Robot.load(path).joint_names == ("Drehgelenk für Rück",)


UNREAD = {  # what has no effect, and a URDF with it
    "1 armature of <dynamics>": one_joint(LIMIT + '<dynamics armature="1"/>'),
    "1 stiffness of <dynamics>": one_joint(LIMIT + '<dynamics damping="1" stiffness="2"/>'),
    "1 jerk of <limit>": one_joint(LIMIT.replace("/>", ' jerk="9"/>')),
    "1 <rotor_inertia>": robot(
        link("base"),
        ARM,
        HINGE,
        '<transmission name="t" xmlns:d="urn:drake"><joint name="hinge"/><actuator name="a">'
        '<mechanicalReduction>2</mechanicalReduction><d:rotor_inertia value="1"/></actuator>'
        "</transmission>",
    ),
    "": robot(
        link("base", "<visual/>" + INERTIAL),
        ARM,
        HINGE,
        "<material/><transmission/><gazebo/><sensor/>",
    ),
}


@pytest.mark.parametrize("name", UNREAD)
def test_what_has_no_effect_is_named_and_no_repair(name, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = Robot.load(write(tmp_path, UNREAD[name]), strict=True)
    notes = [(found.code, f"left out: {name};" in str(found)) for found in loaded.repairs]
    assert notes == ([("unknown-element", True)] if name else [])


def test_limits_of_urdf_1_2_are_those_of_the_guard(tmp_path):
    limit = LIMIT.replace("/>", ' acceleration="3" deceleration="2"/>')
    guard = Robot.load(write(tmp_path, one_joint(limit)), strict=True).guard()
    assert guard.acceleration == 2


def test_a_mass_of_zero_is_not_that_of_the_shapes(tmp_path):
    shape = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    arm = INERTIAL.replace('mass value="1"', 'mass value="0"') + shape
    text = robot(link("base"), link("arm", arm), link("tip"), HINGE, joint("k", "arm", "tip"))
    loaded = Robot.load(write(tmp_path, text), strict=True)
    assert link_inertias(loaded.tables)["arm"].mass < 1e-6


# -- Inertia
# --------------------------------------------------------------------------------------------------

ENTRIES = st.lists(st.floats(-1, 1), min_size=9, max_size=9)


def symmetric(entries):
    half = np.reshape(entries, (3, 3))
    return half + half.T


@settings(max_examples=30)
@given(ENTRIES)
def test_the_nearest_tensor_is_physical(entries):
    moments = np.linalg.eigvalsh(nearest_physical(symmetric(entries)))
    assert moments[0] >= -1e-12
    assert moments[2] <= moments[0] + moments[1] + 1e-12


@settings(max_examples=30)
@given(ENTRIES, st.lists(st.floats(0.1, 1), min_size=3, max_size=3))
def test_no_physical_tensor_is_nearer_than_the_nearest(entries, covariance):
    """A body's tensor is tr(C) - C for a covariance C: any other is at least as far, but for the
    least slenderness.
    """
    tensor, axes = symmetric(entries), np.linalg.eigh(symmetric(entries[::-1]))[1]
    spread = (axes * covariance) @ axes.T
    other = np.trace(spread) * np.eye(3) - spread
    nearest = nearest_physical(tensor)
    slack = 1e-3 * np.linalg.eigvalsh(nearest)[2] + 1e-12
    assert np.linalg.norm(nearest - tensor) <= np.linalg.norm(other - tensor) + slack


@settings(max_examples=30)
@given(ENTRIES)
def test_a_physical_tensor_is_its_own_nearest(entries):
    vectors = np.reshape(entries, (3, 3))
    covariance = vectors @ vectors.T + 0.01 * np.eye(3)
    tensor = np.trace(covariance) * np.eye(3) - covariance
    assert triangle_excess(tensor) < 0
    np.testing.assert_allclose(nearest_physical(tensor), tensor, atol=1e-12)
