"""Configurations of Isaac Lab and ManiSkill: Python that parses, the figures of the law, and differences."""

from __future__ import annotations

import ast
import itertools
import math
import re

import numpy as np
import pytest
from export_cases import DT, JOINTS, motion, random_params, run, values
from hypothesis import example, given, settings
from hypothesis import strategies as st

import batchpid as bp
from batchpid.export import to_isaac_lab, to_maniskill
from batchpid.law import advance_with_mass_matrix
from batchpid.motors import envelope, make_actuators

PD = {"measurement_rate": "measured"}


def configurations(text):
    """Return the class and the arguments of each call in a text."""
    calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    return [(call.func.id, {each.arg: ast.literal_eval(each.value) for each in call.keywords}) for call in calls]


def figure(text, key, joint, default=None):
    """Return the figure of a joint, as Isaac Lab finds it: by regular expressions, 0 for one that a dict lacks."""
    for _, arguments in configurations(text):
        if any(re.fullmatch(each, joint) for each in arguments["joint_names_expr"]):
            found = arguments.get(key, default)
            if isinstance(found, dict):
                return next((value for name, value in found.items() if re.fullmatch(name, joint)), 0.0)
            return found
    raise AssertionError(joint)


def isaac_lab_run(text, columns):
    """Return the efforts (steps, joints) of Isaac Lab 2's explicit actuators, after isaaclab/actuators/actuator_pd.py.

    A DelayedPDActuator takes setpoint, its rate and feedforward of ``max_delay`` steps ago, at first the oldest. A
    DCMotor clips at the line S (+-1 - v / v0), the speed at v0 (1 + L / S), and at the effort limit L.
    """
    efforts = np.zeros_like(columns[0])
    for j, joint in enumerate(JOINTS):
        keys = ("stiffness", "damping", "effort_limit", "velocity_limit", "saturation_effort")
        k, c, most, speed, stall = (figure(text, key, joint) for key in keys)
        late = np.maximum(np.arange(len(efforts)) - figure(text, "max_delay", joint, 0), 0)
        for at, (q, v) in enumerate(zip(columns[1][:, j], columns[3][:, j], strict=True)):
            r, v_d, ff = (columns[each][late[at], j] for each in (0, 2, 4))
            low, high = -most, most
            if stall is not None:
                end = speed * (1 + most / stall)
                line = np.clip(v, -end, end) / speed
                low, high = max(stall * (-1 - line), -most), min(stall * (1 - line), most)
            efforts[at, j] = min(max(k * (r - q) + c * (v_d - v) + ff, low), high)
    return efforts


GAINS = {"kp": [40.0, 20.0, 1 / 3], "kd": [2.0, 0.3, 0.1]}


@pytest.mark.parametrize("limit", [[30.0, 4.0, 1.0], [30.0, math.inf, 1.0], math.inf])
def test_an_ideal_pd_is_the_law(limit):
    params = bp.make_params(3, **GAINS, effort_limit=limit, **PD)
    text, differences = to_isaac_lab(params, JOINTS, DT, model="ideal_pd")
    assert differences == ()
    np.testing.assert_allclose(isaac_lab_run(text, motion()), run(params, motion()), rtol=1e-12, atol=1e-12)


def test_a_delayed_pd_is_the_law_with_a_late_setpoint():
    motors, steps = make_actuators(3, command_delay=[0.008, 0.0, 0.012]), (2, 0, 3)
    params = bp.make_params(3, **GAINS, effort_limit=[30.0, 4.0, math.inf], **PD)
    text, differences = to_isaac_lab(params, JOINTS, DT, actuators=motors)
    assert [each.partition(":")[0] for each in differences] == ["command_delay"]
    late = [column.copy() for column in motion()]
    for at, (j, delay) in itertools.product((0, 2, 4), enumerate(steps)):
        late[at][delay:, j], late[at][:delay, j] = late[at][: len(late[at]) - delay, j].copy(), late[at][0, j]
    np.testing.assert_allclose(isaac_lab_run(text, motion()), run(params, late), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("limit", [math.inf, [30.0, 5.0, 20.0]])
def test_a_dc_motor_is_the_law_within_the_motors_envelope(limit):
    """The third joint's motor is ideal, the second's has an infinite speed."""
    line = {"saturation_effort": [60.0, 9.0, math.inf], "no_load_speed": [8.0, math.inf, 1.0], "effort_limit": limit}
    params, motors = bp.make_params(3, 400.0, None, 2.0, **PD), make_actuators(3, **line)
    text, differences = to_isaac_lab(params, JOINTS, DT, actuators=motors)
    assert differences == ()
    columns = motion()
    low, high = envelope.limits(envelope.envelope(motors), columns[1], columns[3])
    expected = np.clip(run(params, columns), low, high)
    np.testing.assert_allclose(isaac_lab_run(text, columns), expected, rtol=1e-7, atol=1e-9)
    assert (np.isclose(expected, low) | np.isclose(expected, high)).sum() > 100


@given(random_params())
@example(bp.make_params(3, 0.0, 0.0, 0.0, integral_min=0.5, integral_max=0.5, **PD))
@settings(max_examples=25)
def test_params_without_a_listed_difference_have_the_targets_efforts(params):
    params = params.replace(gain_units="effort", dtype=np.float64)
    text, differences = to_isaac_lab(params, JOINTS, DT, model="ideal_pd")
    if not differences:
        ours = run(params, motion())
        np.testing.assert_allclose(isaac_lab_run(text, motion()), ours, atol=1e-9 * max(1.0, np.abs(ours).max()))


@pytest.mark.parametrize("target", ["implicit", "maniskill"])
def test_an_implicit_drive_is_the_implicit_law(target):
    """PhysX's drive under PGS acts at the end of the step: m (v+ - v) / dt = k (r - q+) - c v+, q+ = q + dt v+."""
    options = {"gain_units": "mass_matrix", "discretization": "implicit"}
    params = bp.make_params(3, [900.0, 400.0, 50.0], None, [60.0, 20.0, 30.0], **options, **PD)
    m = np.array([2.0, 1.0, 0.05])
    to = {"implicit": to_isaac_lab, "maniskill": to_maniskill}[target]
    text, differences = to(params, JOINTS, DT, inertia=m)
    assert [each.partition(":")[0] for each in differences] == ["gain_units", "law"]
    ((_, arguments),) = configurations(text)
    k, c = (
        np.array(list(figures.values()) if isinstance(figures := arguments[key], dict) else figures)
        for key in ("stiffness", "damping")
    )
    r, coefficients = np.array([1.0, -0.5, 0.2]), bp.discretise(params, DT)
    q, v, x, w = np.zeros(3), np.zeros(3), np.zeros((1, 3)), np.zeros((1, 3))
    state = bp.init(params, x)
    for _ in range(100):
        v = (v + DT * k * (r - q) / m) / (1 + DT * c / m + DT**2 * k / m)
        q = q + DT * v
        state, terms = advance_with_mass_matrix(coefficients, state, r[None], x, np.diag(m)[None], w)
        w = w + DT * terms.effort / m
        x = x + DT * w
        np.testing.assert_allclose(x[0], q, rtol=1e-10, atol=1e-12)
    assert np.abs(q - r).max() < 0.3


def test_motors_are_grouped_by_what_a_configuration_has_once():
    motors = make_actuators(
        3, saturation_effort=[60.0, 9.0, 60.0], no_load_speed=[8.0, 20.0, 9.0], armature=0.01, coulomb=0.2
    )
    text, differences = to_isaac_lab(bp.make_params(3, 1.0, **PD), JOINTS, DT, actuators=motors)
    assert differences == ()
    (first, one), (second, other) = configurations(text)
    assert (first, second) == ("DCMotorCfg", "DCMotorCfg")
    assert (one["joint_names_expr"], other["joint_names_expr"]) == (["shoulder", "wrist"], ["elbow"])
    assert one["velocity_limit"] == {"shoulder": 8.0, "wrist": 9.0}
    assert (one["armature"], one["friction"], one["dynamic_friction"]) == (0.01, 0.2, 0.2)
    assert one["effort_limit"] == 1e9
    partly = motors.replace(saturation_effort=[60.0, np.inf, 60.0])
    text = to_isaac_lab(bp.make_params(3, 1.0, **PD), JOINTS, DT, actuators=partly).text
    assert [cls for cls, _ in configurations(text)] == ["DCMotorCfg", "IdealPDActuatorCfg"]
    assert "import DCMotorCfg, IdealPDActuatorCfg" in text


def test_delays_are_whole_steps_of_the_setpoint():
    motors = make_actuators(3, command_delay=[0.008, 0.008, 0.0101])
    params = bp.make_params(3, 100.0, None, 20.0, **PD)
    text, differences = to_isaac_lab(params, JOINTS, DT, actuators=motors, inertia=[1.0, 1.0, 1.0])
    assert [figure(text, "min_delay", joint) for joint in JOINTS] == [2, 2, 3]
    assert [figure(text, "max_delay", joint) for joint in JOINTS] == [2, 2, 3]
    rounded, late = differences
    assert "wrist 3" in rounded
    w = max(np.sqrt(np.roots([1.0, -(20.0**2), -(100.0**2), 0.0]).real.max()), 0)
    assert f"{math.degrees(w * 0.0101):.2g} degrees" in late


def test_a_delay_of_no_step_leaves_the_line_of_the_motors():
    motors = make_actuators(3, command_delay=0.4 * DT, saturation_effort=9.0, no_load_speed=20.0)
    text, differences = to_isaac_lab(bp.make_params(3, 1.0, **PD), JOINTS, DT, actuators=motors)
    assert [cls for cls, _ in configurations(text)] == ["DCMotorCfg"]
    assert [each.partition(":")[0] for each in differences] == ["command_delay"]


def test_names_are_no_patterns():
    text = to_isaac_lab(bp.make_params(2, [1.0, 2.0], **PD), ["a.b", "a+b"], DT).text
    assert (figure(text, "stiffness", "a.b"), figure(text, "stiffness", "a+b")) == (1.0, 2.0)
    with pytest.raises(AssertionError):
        figure(text, "stiffness", "axb")


def test_maniskill_has_lists_in_the_order_of_the_joints():
    params = bp.make_params(3, [40.0, 20.0, 1 / 3], None, 0.1, effort_limit=[30.0, math.inf, 1.0], **PD)
    ((cls, arguments),) = configurations(to_maniskill(params, JOINTS, DT).text)
    assert cls == "PDJointPosControllerConfig"
    assert arguments == {
        "joint_names": JOINTS,
        "lower": None,
        "upper": None,
        "stiffness": [40.0, 20.0, 1 / 3],
        "damping": [0.1, 0.1, 0.1],
        "force_limit": [30.0, 1e10, 1.0],
        "friction": 0.0,
        "normalize_action": False,
    }


@given(random_params(), st.sampled_from(["implicit", "ideal_pd", "maniskill"]))
@example(bp.make_params(3, 0.0, 0.0, integral_min=1e-10), "implicit")
@settings(max_examples=30, deadline=None)
def test_nothing_is_lost_that_is_not_listed(params, target):
    inertia = np.array([2.0, 1.0, 0.5])
    options = {} if target == "maniskill" else {"model": target}
    to = to_maniskill if target == "maniskill" else to_isaac_lab
    text, differences = to(params, JOINTS, DT, inertia=inertia, **options)
    listed = {each.partition(":")[0] for each in differences}
    key = {"implicit": "effort_limit_sim", "ideal_pd": "effort_limit", "maniskill": "force_limit"}[target]
    if target == "maniskill":
        ((_, arguments),) = configurations(text)
        p, d, limit = (arguments[name] for name in ("stiffness", "damping", key))
        limit = [math.inf if each == 1e10 else each for each in limit]
    else:
        p, d = ([figure(text, name, joint) for joint in JOINTS] for name in ("stiffness", "damping"))
        limit = [math.inf if (x := figure(text, key, joint)) == 1e9 else x for joint in JOINTS]
    scale = 1.0 if params.gain_units is None else inertia
    tolerance = 1e-12 if params.dtype == np.float64 else 1e-6
    np.testing.assert_allclose(p, np.array(values(params, "kp")) * scale, rtol=tolerance)
    np.testing.assert_allclose(d, np.array(values(params, "kd")) * scale, rtol=tolerance)
    if not listed & {"effort_limit"} or target == "implicit":
        low, high = (np.array(values(params, name)) for name in ("effort_min", "effort_max"))
        np.testing.assert_allclose(limit, np.clip(np.minimum(-low, high), 0, None), rtol=1e-12)
    damps, integral_ends = params.kd is not None, [values(params, f"integral_{end}") for end in ("min", "max")]
    needed = {
        "ki": any(values(params, "ki")),
        "integral_limit": params.ki is not None and any(np.clip(0.0, *integral_ends)),
        "effort_rate_limit": params.effort_rate_limit is not None,
        "setpoint_weight": params.setpoint_weight is not None,
        "setpoint_weight_derivative": damps and params.setpoint_weight_derivative is not None,
        "derivative_filter_time": damps and params.derivative_filter_time is not None,
        "measurement_rate": damps and params.measurement_rate is None,
        "deadband": params.deadband is not None,
        "continuous": params.continuous is not None,
        "non_finite": params.non_finite is not None,
        "gain_units": params.gain_units is not None,
        "law": target != "ideal_pd",
    }
    assert {name for name, lost in needed.items() if lost} == listed - {"effort_limit"}
