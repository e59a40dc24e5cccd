"""Gains and motors read from actuator configurations of Isaac Lab: of an export, and as people write them."""

from __future__ import annotations

import numpy as np
import pytest
from export_cases import DT, JOINTS, random_params, values
from hypothesis import given, settings
from hypothesis import strategies as st

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.export import from_isaac_lab, to_isaac_lab

MINE = """
import isaaclab.sim as sim_utils
from isaaclab import actuators
raise SystemExit("never executed")
ARMATURE, HERTZ = 0.01, 10
INERTIA = 0.02
STIFFNESS = INERTIA * (HERTZ_ := 3)
OMEGA = 2.0 * math.pi * 5
ROBOT = ArticulationCfg(
    spawn=sim_utils.UsdFileCfg(usd_path=f"{ROOT}/arm.usd"),
    actuators={
        "arm": actuators.IdealPDActuatorCfg(
            joint_names_expr=["shoulder", "elb.*"],
            stiffness={"shoulder": INERTIA * OMEGA**2, ".*bow": 20},
            damping=2.5,
            effort_limit=40.0,
            velocity_limit=3.0,
            armature=INERTIA / 2,
        ),
        "hand": actuators.DelayedPDActuatorCfg(
            joint_names_expr=["wr.*"], stiffness=5.0, damping=0.1, friction=0.3, min_delay=0, max_delay=4
        ),
    },
)
"""


def test_configurations_by_hand_are_read_and_not_executed():
    params, joints, differences, motors = from_isaac_lab(MINE, JOINTS, dt=0.005)
    assert joints == JOINTS
    np.testing.assert_allclose(params.kp, [[0.02 * (10 * np.pi) ** 2, 20.0, 5.0]], rtol=1e-15)
    np.testing.assert_array_equal(params.kd, [[2.5, 2.5, 0.1]])
    np.testing.assert_array_equal(params.effort_max, [[40.0, 40.0, np.inf]])
    np.testing.assert_array_equal(motors.armature, [[0.01, 0.01, 0.0]])
    np.testing.assert_array_equal(motors.coulomb, [[0.0, 0.0, 0.3]])
    np.testing.assert_array_equal(motors.command_delay, [[0.0, 0.0, 0.01]])
    assert [each.partition(":")[0] for each in differences] == ["command_delay", "velocity_limit", "command_delay"]
    unknown = from_isaac_lab(MINE, JOINTS[::-1])
    assert unknown.actuators.command_delay is None
    assert "not read" in unknown.differences[-1]
    np.testing.assert_array_equal(unknown.params.kp, params.kp[:, ::-1])


def test_a_number_is_the_one_that_was_defined_before():
    arm = 'ImplicitActuatorCfg(joint_names_expr=["{0}"], stiffness=KP, damping=1.0)'
    text = f"KP: float = 10\nA = {arm.format('a')}\nKP = 2 * KP\nB = {arm.format('b')}\nB.stiffness = 30\nKP += 1\n"
    found = from_isaac_lab(text, ["a", "b"])
    np.testing.assert_array_equal(found.params.kp, [[10, 20]])
    assert found.differences[-1] == "line 5: not read: B.stiffness = 30"
    with pytest.raises(InvalidArgumentError, match="KP is not a number"):
        from_isaac_lab(text + f"C = {arm.format('c')}", ["a", "b", "c"])


@given(random_params(), st.sampled_from(["implicit", "ideal_pd", "dc_motor", "delayed_pd"]), st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_a_round_trip_loses_only_what_is_listed(params, model, seed):
    rng = np.random.default_rng(seed)
    coulomb = rng.uniform(0, 2, 3)
    own = {
        "armature": rng.uniform(0, 1, 3),
        "coulomb": coulomb,
        "static": coulomb * 1.5,
        "viscous": rng.uniform(0, 1, 3),
    }
    if model == "dc_motor":
        own |= {"saturation_effort": rng.uniform(1, 99, 3), "no_load_speed": rng.uniform(1, 9, 3), "effort_limit": 30.0}
    if model == "delayed_pd":
        own["command_delay"] = DT * rng.integers(0, 5, 3)
    motors = bp.make_actuators(3, **own)
    inertia = np.array([2.0, 1.0, 0.5])
    exported = to_isaac_lab(params, JOINTS, DT, actuators=motors, model=model, inertia=inertia)
    back = from_isaac_lab(exported.text, JOINTS, dt=DT)
    listed = {each.partition(":")[0] for each in exported.differences}
    scale, tolerance = 1.0 if params.gain_units is None else inertia, 1e-12 if params.dtype == np.float64 else 1e-6
    for name in ("kp", "kd"):
        np.testing.assert_allclose(values(back.params, name), np.array(values(params, name)) * scale, rtol=tolerance)
    high = np.array(values(params, "effort_max")) if "effort_limit" not in listed or model == "implicit" else None
    if high is not None and np.array_equal(high, np.negative(values(params, "effort_min"))):
        limit = np.minimum(high, 30.0) if model == "dc_motor" else high
        np.testing.assert_allclose(values(back.params, "effort_max"), limit, rtol=tolerance)
    for name in set(own) - {"effort_limit"}:
        was, now = getattr(motors, name), getattr(back.actuators, name)
        np.testing.assert_allclose(0.0 if now is None else now, 0.0 if was is None else was, rtol=1e-12, atol=1e-18)
    lost = {"ki", "effort_rate_limit", "setpoint_weight", "setpoint_weight_derivative", "derivative_filter_time"}
    lost |= {"deadband", "continuous", "non_finite"}
    for name in lost - listed:
        if name in ("setpoint_weight_derivative", "derivative_filter_time") and params.kd is None:
            continue
        assert getattr(params, name) is None or not np.any(getattr(params, name)), name


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        ("stiffness=5.0", "stiffness=None", "gives no stiffness.*wrist|wrist.*gives no stiffness"),
        ("stiffness=5.0, ", "", "gives no stiffness"),
        ("max_delay=4", "**LIMITS", "unpacked from a dict"),
        ("stiffness=5.0", "stiffness=read()", r"read\(\) is not a number \(got 'line 2\d'"),
        ("stiffness=5.0", "stiffness=9**9**9", "is not a number"),
        ("stiffness=5.0", "stiffness='5'", "stiffness is not a number"),
        ("stiffness=5.0", "stiffness=-5.0", "kp"),
        ('["wr.*"]', '["finger"]', "no actuators of the text match"),
        ('["wr.*"]', '[".*"]', "several actuators"),
        ('["wr.*"]', '["("]', "regular expression"),
        ('".*bow"', '".*"', "several keys of stiffness"),
        ("effort_limit=40.0", "effort_limit={'shoulder': 40.0}", "effort_limit has no key"),
        ("DelayedPDActuatorCfg", "ActuatorNetLSTMCfg", "ActuatorNetLSTMCfg"),
        ("joint_names_expr", "joints", "holds no actuators"),
        ("ROBOT = ", "ROBOT = = ", "is not Python"),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(before, after, named):
    assert before in MINE
    with pytest.raises(InvalidArgumentError, match=named):
        from_isaac_lab(MINE.replace(before, after), JOINTS)


CFG = "ImplicitActuatorCfg(joint_names_expr=['j'], stiffness={}, damping=1)"


@pytest.mark.parametrize(
    "text",
    [
        f"K = 7\ndef f(K):\n    return {CFG.format('K')}",
        f"K = 7\nfor K in (1, 2):\n    x = {CFG.format('K')}",
        f"K = 7\nx = [{CFG.format('K')} for K in (1, 2)]",
        f"K = 7\nfrom other import K\nx = {CFG.format('K')}",
        f"K = 7\nfrom other import *\nx = {CFG.format('K')}",
        f"K = 7\ndef K(): pass\nx = {CFG.format('K')}",
        f"K = 7\ndel K\nx = {CFG.format('K')}",
        f"D = {{'j': 1}}\nD['j'] = 5\nx = {CFG.format('D')}",
        f"D = {{'j': 1}}\nD.update(j=5)\nx = {CFG.format('D')}",
        f"D = {{'j': 1}}\nE = D\nE['j'] = 5\nx = {CFG.format('D')}",
        f"x = {CFG.format('other.pi')}",
    ],
)
def test_a_number_that_may_be_another_is_refused(text):
    with pytest.raises(InvalidArgumentError, match="is not a number"):
        from_isaac_lab(text, ["j"])


def test_numbers_of_an_assignment_are_those_before_it():
    found = from_isaac_lab(
        f"K = 7\nD = {{'j': K}}\nK = {CFG.format('K')}\nx = {CFG.format('D').replace('j', 'k', 1)}", ["j"]
    )
    assert found.params.kp[0, 0] == 7


def test_what_changes_a_configuration_is_told():
    """Arguments that no class has, keys that no joint matches, and changes after the call."""
    text = f"""
x = {CFG.format("{'j': 1, 'j1O': 2}").replace(")", ", gear=3)")}
y = x.replace(stiffness=3)
setattr(x, "damping", 4)
x.effort_limit = 5
"""
    differences = from_isaac_lab(text, ["j"]).differences
    for said in (
        "gear: not read",
        "stiffness: no joint matches 'j1O'",
        "line 3: not read",
        "line 4: not",
        "line 5: not",
    ):
        assert sum(said in each for each in differences) == 1, said
