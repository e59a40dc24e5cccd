"""Gains as a controller configuration of ManiSkill 3 (mani_skill/agents/controllers/pd_joint_pos.py): Python text."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from batchpid.checks.validate import identifier
from batchpid.export.exported import Exported
from batchpid.export.pd_drive import Drive
from batchpid.law.params import PIDParams
from batchpid.motors.actuators import Actuators

NO_LIMIT = 1e10
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
        "force_limit": [min(each, NO_LIMIT) for each in found.effort_limit.tolist()],
        "friction": 0.0,
        "normalize_action": False,
    }
    body = "".join(f"    {key}={value!r},\n" for key, value in lists.items())
    imports = "from mani_skill.agents.controllers import PDJointPosControllerConfig\n\n"
    start = f"{found.opening('Controller for ManiSkill')}{imports}"
    return Exported(f"{start}{name} = PDJointPosControllerConfig(\n{body})\n", tuple(found))
