"""Gains and motors as actuators of newton (newton.actuators): Python text.

A drive with the error e, the velocity error v_d - v, the feedforward ff and the limits of its clamps (newton 1.8,
newton/_src/actuators: drives/drive_pid.py, delay.py, clamping/)::

    A      <- min(max(A + dt e, -integral_max), integral_max)
    effort  = clamped(kp e + ki A + kd (v_d - v) + ff)

That is this package's law with the measured velocity, which integrates first, without anti-windup, in float32. A delay
is of the setpoint, its rate and the feedforward, in whole steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Document
from batchpid.checks.validate import identifier
from batchpid.export.exported import Exported
from batchpid.export.pd_drive import Drive
from batchpid.law.params import PIDParams
from batchpid.motors.actuators import Actuators

JOINT_FIELDS = {"armature": "joint_armature", "coulomb": "joint_friction", "viscous": "joint_damping"}
"""Effects of actuators that newton's ModelBuilder has for each joint, with their names there."""


def to_newton(
    params: PIDParams,
    joint_names: Sequence[str],
    dt: float,
    *,
    actuators: Actuators | None = None,
    name: str = "ACTUATORS",
    inertia: ArrayLike | None = None,
) -> Exported:
    """Return actuators for newton as Python text, and their differences from the law.

    The text defines a dict ``name`` of drive, clamps and gains of each joint, the joints' armature, friction and
    damping, and the function ``add_actuators(builder, dofs)``, which adds all of them to a ``newton.ModelBuilder``;
    ``dofs`` maps the names of the joints to their indices in ``joint_qd``.

    ``actuators`` are motors of one env: command delay, torque-speed line, effort limits, also by position, armature,
    Coulomb and viscous friction. ``name`` is the name of the dict. Other parameters and the errors are as in
    :func:`batchpid.export.to_isaac_lab`.
    """
    identifier("name", name)
    found = Drive(params, joint_names, dt, inertia, actuators, integrates=True)
    found.compare_integral(first=True)
    delay = found.delay_steps()
    found.lack_motors(("saturation_effort", "command_delay", "position_limit", *JOINT_FIELDS))
    # The text is a table and one loop, not a call per joint: a reader compares gains line by line.
    used, rows = set[str](), []
    for at, joint in enumerate(found.joints):
        drive, clamps, options = _drive(found, at), _clamps(found, at), _gains(found, at)
        if delay[at]:
            options["delay_steps"] = delay[at]
        used |= {drive, *(cls for cls, _ in clamps)}
        listed = ", ".join(f"({cls}, {values!r})" for cls, values in clamps)
        rows.append(f"    {joint!r}: ({drive}, [{listed}], {options!r}),\n")
    joints = {
        field: {joint: float(values[at]) for at, joint in enumerate(found.joints) if values[at]}
        for effect, field in JOINT_FIELDS.items()
        if (values := found.motor(effect)).any()
    }
    fields = "".join(f"    {field!r}: {values!r},\n" for field, values in joints.items())
    return Exported(
        f"""{found.opening("Actuators for newton")}from newton.actuators import {", ".join(sorted(used))}

{name} = {{
{"".join(rows)}}}
JOINTS = {{
{fields}}}


def add_actuators(builder, dofs):
    for joint, (drive, clamping, options) in {name}.items():
        builder.add_actuator(drive, dofs[joint], clamping=clamping, **options)
    for field, values in JOINTS.items():
        for joint, value in values.items():
            getattr(builder, field)[dofs[joint]] = value
""",
        tuple(found),
    )


def _drive(found: Drive, at: int) -> str:
    return "DrivePID" if found.value("ki")[at] > 0 and found.integral_limit[at] > 0 else "DrivePD"


def _gains(found: Drive, at: int) -> Document:
    gains: Document = {"kp": float(found.value("kp")[at]), "kd": float(found.value("kd")[at])}
    if _drive(found, at) == "DrivePID":
        gains["ki"] = float(found.value("ki")[at])
        if math.isfinite(limit := found.integral_limit[at]):
            gains["integral_max"] = float(limit / gains["ki"])
    return gains


def _clamps(found: Drive, at: int) -> list[tuple[str, Document]]:
    """Return the clamps of a joint, by the names of their classes."""
    limit, stall = (float(values[at]) for values in (found.effort_limit, found.motor("saturation_effort", math.inf)))
    clamps: list[tuple[str, Document]] = []
    if math.isfinite(limit):
        clamps.append(("ClampingMaxEffort", {"max_effort": limit}))
    if math.isfinite(stall):
        speed = float(found.motor("no_load_speed", math.inf)[at])
        line = {"saturation_effort": stall, "velocity_limit": speed}
        motor = float(found.motor("effort_limit", math.inf)[at])
        clamps.append(("ClampingDCMotor", line | ({"max_motor_effort": motor} if math.isfinite(motor) else {})))
    positions, efforts = found.actuators.limit_positions, found.actuators.limit_efforts
    if positions is not None and np.isfinite(efforts[0, at]).all():
        table = {"lookup_positions": positions[0, at].tolist(), "lookup_efforts": efforts[0, at].tolist()}
        clamps.append(("ClampingPositionBased", table))
    return clamps
