r"""Parameters of operational-space control at a time step: build, broadcast, validate.

The law's coefficients are marked with an asterisk in the acceleration of the task
(:mod:`batchpid.task_space.operational_space`), where e is the error of the pose, v the twist of the
tool, V and V' the twist and acceleration of the setpoint, and I the integral::

    a = kp* e - kd* v + c* V + g* V' + I        I <- I + ki* dt e - ki2* V

- "explicit": kp* = kp, kd* = c* = kd, g* = 1, ki* = ki and ki2* = 0. Decoupled axes are stable for
  w dt < 0.828 with kp = w^2, kd = 2 w.
- "implicit": the error, the twist and the integral are those at the end of the step, where V and V'
  are given. As for joints (:mod:`batchpid.law.coefficients`), with D = 1 + dt kd + dt^2 kp + dt^3 ki::

      kp* = (kp + dt ki) / D      kd* = (kd + dt kp + dt^2 ki) / D      c* = kd / D      g* = 1 / D      ki* = ki / D

  and ki2* = ki* dt^2. A pole s becomes 1 / (1 - s dt): decoupled axes are stable at any dt.

The posture has the same law, without V and integral.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import CHOICES, Array
from batchpid.arrays.elementwise import TURN
from batchpid.arrays.field_tables import Field
from batchpid.arrays.records import LeafBuilder, array_summary, with_fields
from batchpid.checks import AxisKind, choice, entries, instance, read_array, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.task_space.rigid_tree import MAKE_TREE, RigidTree
from batchpid.task_space.tree_kinematics import check_masses

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Names of the axes of a task."""
LIMIT_STIFFNESS = 400.0
"""Of the springs that push joints away from their limits [1/s^2]."""
OSC_FIELDS = {
    "stiffness": Field("1/s^2", group="axis", default=150.0),
    "damping_ratio": Field("1", 1.0, group="axis", default=1.0),
    "posture_stiffness": Field("1/s^2", group="joint", default=10.0),
    "limit_margin": Field("rad or m", group="joint", default=0.0),
    "position_error_limit": Field("m", math.inf, above=True, group="norm", default=0.1),
    "rotation_error_limit": Field("rad", math.inf, above=True, group="norm", default=0.5),
    "smallest_eigenvalue": Field("1/kg or 1/(kg m^2)", above=True, group="s0", default=0.02),
    "effort_limit": Field("N m or N", math.inf, group="joint"),
    "integral_gain": Field("1/s^3", group="axis", default=0.0),
    "integral_limit": Field("m/s^2 or rad/s^2", math.inf, group="axis", default=math.inf),
}
"""Options with a value for each axis or joint, or one for each env."""


class OSCParams(NamedTuple):
    """Parameters of operational-space control at a time step, for one tool of one kind of robot.
    Build them with :func:`make_osc_params`.

    Every leaf is a float64 array of one row or one per env; None is off.
    """

    kp: Array
    """kp* (1 | envs, 6) [1/s^2]."""
    kd: Array
    """kd* (1 | envs, 6) [1/s]."""
    c: Array
    """c* (1 | envs, 6) [1/s]."""
    acceleration_share: Array
    """g* (1 | envs, 6)."""
    posture_kp: Array
    """(1 | envs, dof) [1/s^2]."""
    posture_kd: Array
    """(1 | envs, dof) [1/s]."""
    position_error_limit: Array
    """(1 | envs, 1) [m]."""
    rotation_error_limit: Array
    """(1 | envs, 1) [rad]."""
    smallest_eigenvalue: Array
    """s0 (1 | envs, 1) [1/kg, 1/(kg m^2)]."""
    axes: Array = None
    """1.0 for the axes whose motion is controlled (1, 6); None for all."""
    effort_limit: Array = None
    """(1 | envs, dof) [N m or N]."""
    ki_dt: Array = None
    """ki* dt (1 | envs, 6) [1/s^2]."""
    ki_dt2: Array = None
    """ki2* (1 | envs, 6) [1/s]."""
    integral_limit: Array = None
    """(1 | envs, 6) [m/s^2, rad/s^2]."""
    limit_kp: Array = None
    """(1 | envs, dof) [1/s^2]; 0 for joints without a margin."""
    limit_kd: Array = None
    """Damping over margin (1 | envs, dof)."""
    limit_low: Array = None
    """Positions (1 | envs, dof) from which joints are pushed back: limits less their margins."""
    limit_high: Array = None
    turns: Array = None
    """1 / (2 pi) for joints of the tree that turn without limits, whose posture is the one next to
    qpos, else 0 (1, dof); None without such joints.
    """

    def __repr__(self) -> str:
        return array_summary(self)


@with_fields(*OSC_FIELDS)
def make_osc_params(
    tree: RigidTree,
    dt: float,
    *,
    axes: Sequence[bool] = (True,) * len(AXES),
    discretization: str = "explicit",
    **options: ArrayLike,
) -> OSCParams:
    """Build validated :class:`OSCParams` for a tool of ``tree`` at the time step ``dt`` [s].

    A number may be a scalar, one per axis (6,) or joint (dof,), or one per env as well, (envs, 6)
    or (envs, dof).

    Parameters
    ----------
    stiffness, damping_ratio
        kp >= 0 [1/s^2] of the axes x, y, z, rx, ry, rz, and zeta of kd = 2 zeta sqrt(kp).
    integral_gain, integral_limit
        ki [1/s^3], which learns loads that the model does not know, and the largest size of the
        integral of each axis [m/s^2, rad/s^2]. A loop with kp and kd is stable for ki < kp kd.
    axes
        The axes whose motion is controlled; the posture moves the others.
    posture_stiffness
        Stiffness of the joints' critically damped springs to their posture: within the null space
        of the task for the joints of the chain to the tool, fully for others, such as fingers
        [1/s^2]. Followers have none.
    limit_margin
        Joints of the chain that come nearer to a position limit than the margin [rad or m], or a
        quarter of their range, are pushed away within the null space, by a critically damped spring
        of 400/s^2. 0: no margin.
    position_error_limit, rotation_error_limit
        Largest norm of the error that enters the law [m, rad]; inf for none.
    smallest_eigenvalue
        s0 > 0 of the bounded inverse (:mod:`batchpid.task_space.operational_space`): below it,
        directions near a singularity lose stiffness; below s0/5 the posture pulls the tool there
        [1/kg, 1/(kg m^2)].
    effort_limit
        Limit of the total effort of the joints [N m or N].
    discretization
        "explicit", or "implicit": stable at any time step.

    Raises
    ------
    InvalidArgumentError
        Naming the option, axis or joint, env and value; also where a gain is unstable at the time
        step: kp* dt^2 + 2 kd* dt > 4.
    """
    check_masses(instance("tree", tree, RigidTree, MAKE_TREE))
    dt = time_step("dt", dt)
    mode = choice("discretization", discretization, CHOICES["discretization"])
    ahead = dt if mode == "implicit" else 0.0  # of the gains: the time at which they act
    columns = {"axis": AXES, "joint": tree.joint_names, "norm": ("norm",), "s0": ("s0",)}
    options = {name: value for name, value in options.items() if value is not None}
    rows: dict[str, Array] = {}
    envs = 1
    for name, field in OSC_FIELDS.items():
        names = columns[field.group]
        kind: AxisKind = "joint" if field.group == "joint" else "entry"
        build = LeafBuilder(len(names), names, kind=kind)
        build.num_envs = envs
        rows[name] = build.array(name, options.get(name, field.default), field)
        envs = build.num_envs

    def at_step(name: str, kp: Array, kd: Array) -> tuple[Array, Array, Array]:
        # kp*, kd* and g* of a law without integral, below the stability bound of the sampled loop
        share = 1 / (1 + ahead * kd + ahead * ahead * kp)
        stiffness, damping = kp * share, (kd + ahead * kp) * share
        entries(
            name,
            kp,
            stiffness * dt * dt + 2 * damping * dt <= 4,
            f"is unstable at a time step of {dt:g} s",
            columns[OSC_FIELDS[name].group],
            kind="entry" if name == "stiffness" else "joint",
            remedy="lower it, use a smaller time step, or discretization='implicit'",
        )
        return stiffness, damping, share

    kp = rows.pop("stiffness")
    kd = 2 * rows.pop("damping_ratio") * np.sqrt(kp)
    ki = rows.pop("integral_gain")
    rows["kp"], rows["kd"], share = at_step("stiffness", kp + ahead * ki, kd)
    rows["c"], rows["acceleration_share"] = kd * share, share
    if ki.any():
        rows["ki_dt"] = share * ki * dt
        rows["ki_dt2"] = rows["ki_dt"] * ahead
    elif "integral_limit" in options:
        remedy = "leave it out, or give integral_gain"
        raise InvalidArgumentError("integral_limit", "has no effect", remedy=remedy)
    # Followers have no posture and no limits of their own: their leader has them.
    leads = tree.coupling.independent
    kp = rows.pop("posture_stiffness") * leads
    rows["posture_kp"], rows["posture_kd"], _ = at_step("posture_stiffness", kp, 2 * np.sqrt(kp))
    lower, upper = np.array([tree.lower]), np.array([tree.upper])
    margin = np.minimum(rows.pop("limit_margin"), (upper - lower) / 4) * leads
    if margin.any():
        kp = LIMIT_STIFFNESS * (margin > 0)
        rows["limit_kp"], damping, _ = at_step("limit_margin", kp, 2 * np.sqrt(kp))
        rows["limit_kd"] = damping / np.where(margin > 0, margin, 1.0)
        rows["limit_low"], rows["limit_high"] = lower + margin, upper - margin
    motion = read_array("axes", axes, "b")
    if motion.shape != (len(AXES),):
        raise InvalidArgumentError("axes", f"has shape {motion.shape}", remedy="give six bools")
    if not motion.all():
        rows["axes"] = motion[None].astype(float)
    # Joints without limits that turn are angles modulo 2 pi for the posture.
    endless = np.isinf(lower) & np.isinf(upper) & (tree.bodies.slides[:, 0] == 0)
    if endless.any():
        rows["turns"] = endless / TURN
    return OSCParams(**{name: build.freeze(leaf) for name, leaf in rows.items()})
