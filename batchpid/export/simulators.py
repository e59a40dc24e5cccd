"""Gains and motors for other simulators, as Python text.

- Isaac Lab 2: actuator configurations (isaaclab/actuators);
- ManiSkill 3: a controller configuration (mani_skill/agents/controllers/pd_joint_pos.py);
- newton: actuators (newton.actuators). A drive with the error e, the velocity error v_d - v, the feedforward ff and the
  limits of its clamps is (newton 1.8, newton/_src/actuators: drives/drive_pid.py, delay.py, clamping/)::

    A      <- min(max(A + dt e, -integral_max), integral_max)
    effort  = clamped(kp e + ki A + kd (v_d - v) + ff)

  That is this package's law with the measured velocity, which integrates first, without anti-windup, in float32. A
  delay is of the setpoint, its rate and the feedforward, in whole steps.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Document
from batchpid.checks.validate import choice, identifier, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.export.differences import Exported
from batchpid.export.pd_drive import Drive
from batchpid.law.params import PIDParams
from batchpid.motors.actuators import Actuators

ISAAC_CLASSES = {
    "implicit": "ImplicitActuatorCfg",
    "ideal_pd": "IdealPDActuatorCfg",
    "dc_motor": "DCMotorCfg",
    "delayed_pd": "DelayedPDActuatorCfg",
}
ISAAC_FIELDS = ("armature", "coulomb", "static", "viscous")
"""Effects of actuators that Isaac Lab has for each joint."""
ISAAC_NO_LIMIT = 1e9
"""No limit, as in Isaac Lab. Without a number it takes the USD file's limit; in a dict, 0 for a joint without a key."""


def to_isaac_lab(
    params: PIDParams,
    joint_names: Sequence[str],
    dt: float,
    *,
    actuators: Actuators | None = None,
    model: str | None = None,
    name: str = "ACTUATORS",
    inertia: ArrayLike | None = None,
) -> Exported:
    """Return the ``actuators`` of an ``ArticulationCfg`` as Python text, and its differences from the law.

    Parameters
    ----------
    params
        Of one env: (1, joints).
    joint_names
        Names of the joints.
    dt
        Physics step [s]; delays are whole numbers of it.
    actuators
        Motors, of one env: delay, torque-speed line, effort limit, armature, friction.
    model
        ``"implicit"``, ``"ideal_pd"``, ``"dc_motor"`` or ``"delayed_pd"``. Default: "delayed_pd" for motors with a
        command delay of more than half a step, "dc_motor" for others with a torque-speed line, else "implicit".
    name
        Of the variable, a dict of configurations: one for each set of joints with one delay or one stall effort.
    inertia
        As in :func:`batchpid.export.to_ros2_control`.

    Raises
    ------
    InvalidArgumentError
        Params or actuators for several envs, gains per inertia without ``inertia``, or a model without its motors.
    """
    motors = Actuators() if actuators is None else actuators
    has_line = getattr(motors, "saturation_effort", None) is not None
    if model is None:
        delay = getattr(motors, "command_delay", None)
        delayed = delay is not None and bool(np.rint(np.asarray(delay) / time_step("dt", dt)).any())
        model = "delayed_pd" if delayed else "dc_motor" if has_line else "implicit"
    choice("model", model, ISAAC_CLASSES)
    identifier("name", name)
    found = Drive(params, joint_names, dt, inertia, actuators, implicit=model == "implicit")
    if model == "dc_motor" and not has_line:
        remedy = "give actuators with saturation_effort and no_load_speed, or choose another model"
        raise InvalidArgumentError("model", "needs the motors' torque-speed line", value=model, remedy=remedy)
    fields: Document = {"stiffness": found.value("kp"), "damping": found.value("kd")}
    fields["effort_limit_sim" if model == "implicit" else "effort_limit"] = np.minimum(
        found.effort_limit, ISAAC_NO_LIMIT
    )
    coulomb = found.motor("coulomb")
    joint_side = {
        "armature": found.motor("armature"),
        "friction": np.maximum(found.motor("static"), coulomb),
        "dynamic_friction": coulomb,
        "viscous_friction": found.motor("viscous"),
    }
    fields |= {key: values for key, values in joint_side.items() if values.any()}
    whole: Document = {}
    if model == "dc_motor":
        whole["saturation_effort"] = found.motor("saturation_effort", math.inf)
        fields["velocity_limit"] = np.minimum(found.motor("no_load_speed", math.inf), ISAAC_NO_LIMIT)
    if model == "delayed_pd":
        whole |= dict.fromkeys(("min_delay", "max_delay"), found.delay_steps())
    has = {"dc_motor": ("saturation_effort",), "delayed_pd": ("command_delay",)}.get(model, ())
    found.lack_motors((*has, *ISAAC_FIELDS))
    groups: dict[tuple[Any, ...], list[int]] = {}
    for at, key in enumerate(zip(*whole.values(), strict=True) if whole else [()] * len(found.joints)):
        groups.setdefault(key, []).append(at)
    texts, used = [], set()
    for key, joints in groups.items():
        own = dict(zip(whole, key, strict=True))
        # A motor without a torque-speed line among others that have one is ideal.
        cls = ISAAC_CLASSES["ideal_pd" if math.isinf(own.get("saturation_effort", 0.0)) else model]
        texts.append(_group(found, joints, fields, own, cls))
        used.add(cls)
    labels = ["joints"] if len(texts) == 1 else [f"joints_{at}" for at in range(len(texts))]
    body = "".join(f"    {label!r}: {text},\n" for label, text in zip(labels, texts, strict=True))
    imports = f"from isaaclab.actuators import {', '.join(sorted(used))}\n\n"
    return Exported(f"{found.opening('Actuators for Isaac Lab')}{imports}{name} = {{\n{body}}}\n", tuple(found))


def _group(found: Drive, joints: list[int], fields: Document, whole: Document, cls: str) -> str:
    """Return the text of one configuration."""
    names = [re.escape(found.joints[at]) for at in joints]
    lines = [f"joint_names_expr={names!r}"]
    for key, values in fields.items():
        if key == "velocity_limit" and cls != ISAAC_CLASSES["dc_motor"]:
            continue  # of the torque-speed line
        own = {name: float(values[at]) for name, at in zip(names, joints, strict=True)}
        same = len({*own.values()}) == 1
        lines.append(f"{key}={next(iter(own.values())) if same else own!r}")
    figures = {key: value if isinstance(value, int) else float(value) for key, value in whole.items()}
    lines += [f"{key}={value!r}" for key, value in figures.items() if math.isfinite(value)]
    return f"{cls}(\n" + "".join(f"        {line},\n" for line in lines) + "    )"


MANISKILL_NO_LIMIT = 1e10
"""Default of ``force_limit``."""


def to_maniskill(
    params: PIDParams,
    joint_names: Sequence[str],
    dt: float,
    *,
    actuators: Actuators | None = None,
    name: str = "CONTROLLER",
    inertia: ArrayLike | None = None,
) -> Exported:
    """Return a ``PDJointPosControllerConfig`` as Python text, and its differences from the law.

    Its actions are positions [rad or m], not normalised, as setpoints are here. Its friction, a coefficient of PhysX
    without unit, is 0. Parameters and errors are as in :func:`batchpid.export.to_isaac_lab`; ``dt`` is the law's time
    step [s].
    """
    identifier("name", name)
    found = Drive(params, joint_names, dt, inertia, actuators, implicit=True)
    problem = "friction of PhysX is a coefficient, not an effort"
    found.lack_motors((), coulomb=problem, static=problem, load_friction=problem)
    lists = {
        "joint_names": found.joints,
        "lower": None,
        "upper": None,
        "stiffness": found.value("kp").tolist(),
        "damping": found.value("kd").tolist(),
        "force_limit": [min(each, MANISKILL_NO_LIMIT) for each in found.effort_limit.tolist()],
        "friction": 0.0,
        "normalize_action": False,
    }
    body = "".join(f"    {key}={value!r},\n" for key, value in lists.items())
    imports = "from mani_skill.agents.controllers import PDJointPosControllerConfig\n\n"
    start = f"{found.opening('Controller for ManiSkill')}{imports}"
    return Exported(f"{start}{name} = PDJointPosControllerConfig(\n{body})\n", tuple(found))


NEWTON_FIELDS = {"armature": "joint_armature", "coulomb": "joint_friction", "viscous": "joint_damping"}
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
    found.lack_motors(("saturation_effort", "command_delay", "position_limit", *NEWTON_FIELDS))
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
        for effect, field in NEWTON_FIELDS.items()
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
