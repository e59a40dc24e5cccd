"""Actuators of newton: the target's law next to the law, the figures of params and motors, and the list of losses."""

from __future__ import annotations

import math
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from export_cases import DT, JOINTS, motion, random_params, run, values
from hypothesis import given, settings

import batchpid as bp
from batchpid.export import to_newton
from batchpid.motors import envelope

CLASSES = ("DrivePD", "DrivePID", "ClampingMaxEffort", "ClampingDCMotor", "ClampingPositionBased")


class Builder:
    """Record of the calls of a ModelBuilder, with the methods and lists of newton's."""

    def __init__(self):
        self.actuators, self.joint_armature, self.joint_friction, self.joint_damping = (
            {},
            [0.0] * 9,
            [0.0] * 9,
            [0.0] * 9,
        )

    def add_actuator(self, drive_class, index, clamping=None, delay_steps=None, **gains):
        self.actuators[index] = SimpleNamespace(drive=drive_class, clamping=clamping, delay=delay_steps or 0, **gains)


def built(text):
    """Return a builder after the function of the text, with the names of newton's classes in place of the classes."""
    module = ModuleType("newton.actuators")
    vars(module).update({name: name for name in CLASSES})
    kept = {name: sys.modules.get(name) for name in ("newton", "newton.actuators")}
    try:
        sys.modules.update({"newton": ModuleType("newton"), "newton.actuators": module})
        exec(text, space := {})
    finally:
        for name, module in kept.items():
            sys.modules.pop(name) if module is None else sys.modules.update({name: module})
    builder = Builder()
    space["add_actuators"](builder, {joint: 2 * at for at, joint in enumerate(JOINTS)})
    return builder


def clamped(clamps, effort, q, v):
    for kind, own in clamps:
        if kind == "ClampingMaxEffort":
            low, high = -own["max_effort"], own["max_effort"]
        elif kind == "ClampingDCMotor":
            stall, speed = own["saturation_effort"], own["velocity_limit"]
            most = own.get("max_motor_effort", math.inf)
            at = min(max(v, -speed * (1 + most / stall)), speed * (1 + most / stall))
            low, high = max(stall * (-1 - at / speed), -most), min(stall * (1 - at / speed), most)
        else:
            high = np.interp(q, own["lookup_positions"], own["lookup_efforts"])
            low = -high
        effort = min(max(effort, low), high)
    return effort


def target_run(text, columns):
    """Return the efforts (steps, joints) of newton's drives, delays and clamps, one joint after the other."""
    builder, efforts = built(text), np.zeros_like(columns[0])
    for j, actuator in enumerate(builder.actuators.values()):
        integral, history = 0.0, []
        limit = getattr(actuator, "integral_max", math.inf)
        for at, (r, q, v_d, v, ff) in enumerate(zip(*(column[:, j] for column in columns), strict=True)):
            history.append((r, v_d, ff))
            r, v_d, ff = history[max(len(history) - 1 - actuator.delay, 0)]
            integral = min(max(integral + DT * (r - q), -limit), limit)
            effort = actuator.kp * (r - q) + getattr(actuator, "ki", 0.0) * integral + actuator.kd * (v_d - v) + ff
            efforts[at, j] = clamped(actuator.clamping, effort, q, v)
    return efforts


GAINS = {"kp": [40.0, 20.0, 1 / 3], "ki": [50.0, 0.0, 2.0], "kd": [2.0, 0.3, 0.02]}


@pytest.mark.parametrize(
    "options", [{}, {"effort_limit": [30.0, 4.0, 1.0]}, {"integral_limit": 0.2}, {"effort_limit": 3.0, "ki": 0.0}]
)
def test_the_targets_law_gives_the_same_efforts(options):
    params = bp.make_params(3, **GAINS | options, integration="integrate_first", measurement_rate="measured")
    text, differences = to_newton(params, JOINTS, DT)
    assert differences == ()
    np.testing.assert_allclose(target_run(text, motion()), run(params, motion()), rtol=0, atol=1e-11)


def test_motors_go_along():
    own = {
        "saturation_effort": [60.0, 9.0, np.inf],
        "no_load_speed": [8.0, 2.0, 1.0],
        "effort_limit": [30.0, 5.0, 20.0],
    }
    table = [[-1.0, 0.0, 1.0], [20.0, 3.0, 25.0]]
    motors = bp.make_actuators(3, **own, position_limit=table, armature=0.02, coulomb=[0.1, 0.0, 0.3])
    params = bp.make_params(3, 400.0, None, 2.0, measurement_rate="measured")
    text, differences = to_newton(params, JOINTS, DT, actuators=motors)
    assert differences == ()
    columns = motion()
    low, high = envelope.limits(envelope.envelope(motors), columns[1], columns[3])
    expected = np.clip(run(params, columns), low, high)
    found = target_run(text, columns)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
    assert (np.isclose(found, low) | np.isclose(found, high)).sum() > 100
    builder = built(text)
    assert (builder.joint_armature[0:6:2], builder.joint_friction[0:6:2]) == ([0.02] * 3, [0.1, 0.0, 0.3])


def test_a_delay_is_of_the_setpoint_in_whole_steps():
    motors = bp.make_actuators(3, command_delay=[0.008, 0.0, 0.0101], static=0.5, viscous=0.1, strength=0.9)
    params = bp.make_params(3, **GAINS, integration="integrate_first", measurement_rate="measured")
    text, differences = to_newton(params, JOINTS, DT, actuators=motors)
    assert [each.partition(":")[0] for each in differences] == ["command_delay"] * 2 + ["strength", "static"]
    assert [each.delay for each in built(text).actuators.values()] == [2, 0, 3]
    columns = motion()
    late = [column.copy() for column in columns]
    for j, steps in enumerate((2, 0, 3)):
        for column, whole in zip((late[at] for at in (0, 2, 4)), (columns[at] for at in (0, 2, 4)), strict=True):
            column[:, j] = whole[np.maximum(np.arange(len(whole)) - steps, 0), j]
    np.testing.assert_allclose(target_run(text, columns), run(params, late), rtol=0, atol=1e-11)


@given(random_params())
@settings(max_examples=25, deadline=None)
def test_nothing_is_lost_that_is_not_listed(params):
    inertia = np.array([2.0, 1.0, 0.5])
    text, differences = to_newton(params, JOINTS, DT, inertia=inertia)
    listed, actuators = {each.partition(":")[0] for each in differences}, built(text).actuators.values()
    scale = 1.0 if params.gain_units is None else inertia
    tolerance = 1e-12 if params.dtype == np.float64 else 1e-6
    integrates = np.array([each.drive == "DrivePID" for each in actuators])
    for name in ("kp", "ki", "kd"):
        found = np.array([getattr(each, name, 0.0) for each in actuators])
        wanted = np.array(values(params, name)) * scale
        wanted = np.where(integrates, wanted, 0.0) if name == "ki" else wanted
        np.testing.assert_allclose(found, wanted, rtol=tolerance)
    damps, acts = params.kd is not None, any(values(params, "ki"))
    needed = {
        "effort_rate_limit": params.effort_rate_limit is not None,
        "setpoint_weight": params.setpoint_weight is not None,
        "setpoint_weight_derivative": damps and params.setpoint_weight_derivative is not None,
        "derivative_filter_time": damps and params.derivative_filter_time is not None,
        "measurement_rate": damps and params.measurement_rate is None,
        "deadband": params.deadband is not None,
        "continuous": params.continuous is not None,
        "non_finite": params.non_finite is not None,
        "gain_units": params.gain_units is not None,
        "integration": acts and params.integration is None,
    }
    either = {"effort_limit", "integral_limit", "anti_windup"}
    assert {name for name, lost in needed.items() if lost} == listed - either
    if "effort_limit" not in listed:
        limits = [dict(each.clamping).get("ClampingMaxEffort", {}).get("max_effort", math.inf) for each in actuators]
        assert limits == pytest.approx(values(params, "effort_max"), rel=tolerance)
    if "integral_limit" not in listed and params.integral_max is not None:
        limits = [getattr(each, "integral_max", math.inf) * getattr(each, "ki", 0.0) for each in actuators]
        wanted = values(params, "integral_max")
        assert [x for x, on in zip(limits, integrates, strict=True) if on] == pytest.approx(
            [x for x, on in zip(wanted, integrates, strict=True) if on], rel=tolerance
        )


@given(random_params())
@settings(max_examples=25)
def test_params_without_a_listed_difference_have_the_targets_efforts(params):
    params = params.replace(gain_units="effort", dtype=np.float64)
    text, differences = to_newton(params, JOINTS, DT)
    if not differences:
        ours = run(params, motion())
        np.testing.assert_allclose(target_run(text, motion()), ours, atol=1e-9 * max(1.0, np.abs(ours).max()))


def test_newton_itself_computes_the_efforts():
    """Its own classes, where they are installed: efforts in float32."""
    newton = pytest.importorskip("newton")
    wp = pytest.importorskip("warp")
    motors = bp.make_actuators(3, command_delay=[0.008, 0.0, 0.012], saturation_effort=60.0, no_load_speed=8.0)
    options = {"effort_limit": [30.0, 4.0, 1.0], "integral_limit": 0.2, "measurement_rate": "measured"}
    params = bp.make_params(3, **GAINS | options, integration="integrate_first")
    text = to_newton(params, JOINTS, DT, actuators=motors).text
    exec(text, space := {})
    builder, links = newton.ModelBuilder(), []
    for at in range(3):
        links.append(builder.add_link(mass=1.0, inertia=wp.mat33(np.eye(3))))
        builder.add_joint_revolute(parent=links[at - 1] if at else -1, child=links[at], axis=newton.Axis.Z)
    builder.add_articulation(list(range(3)))
    space["add_actuators"](builder, {joint: at for at, joint in enumerate(JOINTS)})
    model = builder.finalize(device="cpu")
    state, control = model.state(), model.control()
    actuators = [(each, each.state(), each.state()) for each in model.actuators]
    found, columns = [], motion(60)
    for r, q, v_d, v, ff in zip(*columns, strict=True):
        for array, row in ((state.joint_q, q), (state.joint_qd, v)):
            array.assign(row.astype(np.float32))
        for name, row in (("joint_target_q", r), ("joint_target_qd", v_d), ("joint_act", ff)):
            getattr(control, name).assign(row.astype(np.float32))
        control.joint_f.zero_()
        for at, (each, now, then) in enumerate(actuators):
            each.step(state, control, now, then, dt=DT)
            actuators[at] = each, then, now
        found.append(control.joint_f.numpy().copy())
    wp.synchronize()
    np.testing.assert_allclose(np.array(found), target_run(text, columns), rtol=1e-4, atol=1e-4)
