"""Gains and motors as actuator configurations of Isaac Lab 2 (isaaclab/actuators): Python text."""

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
from batchpid.export.exported import Exported
from batchpid.export.pd_drive import Drive
from batchpid.law.params import PIDParams
from batchpid.motors.actuators import Actuators

CLASSES = {
    "implicit": "ImplicitActuatorCfg",
    "ideal_pd": "IdealPDActuatorCfg",
    "dc_motor": "DCMotorCfg",
    "delayed_pd": "DelayedPDActuatorCfg",
}
JOINT_FIELDS = ("armature", "coulomb", "static", "viscous")
"""Effects of actuators that Isaac Lab has for each joint."""
NO_LIMIT = 1e9
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
    choice("model", model, CLASSES)
    identifier("name", name)
    found = Drive(params, joint_names, dt, inertia, actuators, implicit=model == "implicit")
    if model == "dc_motor" and not has_line:
        remedy = "give actuators with saturation_effort and no_load_speed, or choose another model"
        raise InvalidArgumentError("model", "needs the motors' torque-speed line", value=model, remedy=remedy)
    fields: Document = {"stiffness": found.value("kp"), "damping": found.value("kd")}
    fields["effort_limit_sim" if model == "implicit" else "effort_limit"] = np.minimum(found.effort_limit, NO_LIMIT)
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
        fields["velocity_limit"] = np.minimum(found.motor("no_load_speed", math.inf), NO_LIMIT)
    if model == "delayed_pd":
        whole |= dict.fromkeys(("min_delay", "max_delay"), found.delay_steps())
    has = {"dc_motor": ("saturation_effort",), "delayed_pd": ("command_delay",)}.get(model, ())
    found.lack_motors((*has, *JOINT_FIELDS))
    groups: dict[tuple[Any, ...], list[int]] = {}
    for at, key in enumerate(zip(*whole.values(), strict=True) if whole else [()] * len(found.joints)):
        groups.setdefault(key, []).append(at)
    texts, used = [], set()
    for key, joints in groups.items():
        own = dict(zip(whole, key, strict=True))
        # A motor without a torque-speed line among others that have one is ideal.
        cls = CLASSES["ideal_pd" if math.isinf(own.get("saturation_effort", 0.0)) else model]
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
        if key == "velocity_limit" and cls != CLASSES["dc_motor"]:
            continue  # of the torque-speed line
        own = {name: float(values[at]) for name, at in zip(names, joints, strict=True)}
        same = len({*own.values()}) == 1
        lines.append(f"{key}={next(iter(own.values())) if same else own!r}")
    figures = {key: value if isinstance(value, int) else float(value) for key, value in whole.items()}
    lines += [f"{key}={value!r}" for key, value in figures.items() if math.isfinite(value)]
    return f"{cls}(\n" + "".join(f"        {line},\n" for line in lines) + "    )"
