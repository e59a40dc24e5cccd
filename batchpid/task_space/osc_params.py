"""Parameters of operational-space control: build, broadcast, validate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import CHOICES, Array, Document, NamedChoice
from batchpid.arrays.elementwise import TURN
from batchpid.arrays.field_tables import Field, declared
from batchpid.arrays.records import (
    LeafBuilder,
    Record,
    array_summary,
    checked_ends,
    frozen,
    with_fields,
)
from batchpid.checks import AxisKind, choice, entries, instance, read_array
from batchpid.errors import InvalidArgumentError
from batchpid.task_space.rigid_tree import MAKE_TREE, RigidTree
from batchpid.task_space.tree_kinematics import check_masses

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Names of the axes of a task."""
MAKE_PARAMS = "build them with make_osc_params"
"""Remedy for params of another type."""


class ToolFrame(NamedChoice):
    """Gains, selected axes and wrenches are in the axes of the tool."""


TASK_CHOICES: dict[str, Document] = {
    "frame": {"world": None, "tool": ToolFrame()},
    "discretization": CHOICES["discretization"],
}
"""Options chosen by name, and the entries of the params; the first is the default."""


class _OSCParamsFields(NamedTuple):
    stiffness: Annotated[Array, Field("1/s^2", group="axis", default=150.0)]
    """kp (1 | envs, 6) [1/s^2]."""
    damping: Annotated[Array, Field("1/s", group="axis")]
    """kd (1 | envs, 6) [1/s]."""
    posture_stiffness: Annotated[Array, Field("1/s^2", group="joint", default=10.0)]
    """(1 | envs, dof) [1/s^2]."""
    posture_damping: Array
    """(1 | envs, dof) [1/s]."""
    position_error_limit: Annotated[
        Array,
        Field(
            "m",
            math.inf,
            above=True,
            group="norm",
            default=0.1,
        ),
    ]
    """(1 | envs, 1) [m]."""
    rotation_error_limit: Annotated[
        Array,
        Field(
            "rad",
            math.inf,
            above=True,
            group="norm",
            default=0.5,
        ),
    ]
    """(1 | envs, 1) [rad]."""
    smallest_eigenvalue: Annotated[
        Array,
        Field(
            "1/kg or 1/(kg m^2)",
            above=True,
            group="s0",
            default=0.02,
        ),
    ]
    """s0 (1 | envs, 1) [1/kg, 1/(kg m^2)]."""
    axes: Annotated[Array, Field(neutral=True, group="axis")] = None
    """1.0 for the axes whose motion is controlled (1 | envs, 6); None for all."""
    force_axes: Annotated[Array, Field(neutral=False, group="axis")] = None
    """1.0 for further axes that the posture must not act on (1 | envs, 6)."""
    effort_min: Annotated[Array, Field("N m or N", -math.inf, low=-math.inf, group="joint")] = None
    """(1 | envs, dof) [N m or N]."""
    effort_max: Annotated[Array, Field("N m or N", math.inf, low=-math.inf, group="joint")] = None
    frame: NamedChoice | None = None
    """None for "world", or a choice without fields."""
    integral_gain: Annotated[Array, Field("1/s^3", group="axis")] = None
    """ki (1 | envs, 6) [1/s^3]."""
    integral_limit: Annotated[
        Array, Field("m/s^2 or rad/s^2", math.inf, group="axis", default=math.inf)
    ] = None
    """(1 | envs, 6) [m/s^2, rad/s^2]."""
    limit_stiffness: Annotated[Array, Field("1/s^2", group="joint", default=400.0)] = None
    """(1 | envs, dof) [1/s^2]."""
    limit_margin: Annotated[Array, Field("rad or m", group="joint")] = None
    """(1 | envs, dof) [rad or m]."""
    limit_low: Array = None
    """Positions (1 | envs, dof) from which joints are pushed back: limits less their margins."""
    limit_high: Array = None
    turns: Array = None
    """1 / (2 pi) for joints of the tree that turn without limits, whose posture is the one next to
    qpos, else 0 (1, dof); None without such joints.
    """
    discretization: NamedChoice | None = None
    """ImplicitLaw(): the gains act on the predicted end of the step; None: on its beginning."""


OSC_FIELDS = declared(_OSCParamsFields, Field) | {
    "damping_ratio": Field("1", 1.0, group="axis", default=1.0),
    "posture_damping_ratio": Field("1", 1.0, group="joint", default=1.0),
    "effort_limit": Field("N m or N", math.inf, group="joint"),
}
"""Options with a value for each axis or joint, or one for each env."""
WITHOUT_EFFECT = {
    "damping_ratio": ("damping", True, "damping is given, too"),
    "integral_limit": ("integral_gain", False, "integral_gain is not given"),
    "limit_stiffness": ("limit_margin", False, "limit_margin is not given"),
}
"""Options that have no effect if another option is given (True) or missing (False): that option,
the flag, the reason.
"""


class OSCParams(Record, _OSCParamsFields):
    """Parameters of operational-space control, for one tool of one kind of robot. Build it with
    :func:`make_osc_params`.

    Every leaf is a float64 array of one row or one per env; None is off.
    """

    __slots__ = ()
    NAME = "params"
    FIELDS = OSC_FIELDS

    def __repr__(self) -> str:
        return array_summary(self, "envs", "axes")


@with_fields(*OSC_FIELDS)
def make_osc_params(
    tree: RigidTree,
    *,
    frame: str = "world",
    discretization: str = "explicit",
    **options: ArrayLike,
) -> OSCParams:
    """Build validated :class:`OSCParams` for a tool of ``tree``.

    A number may be a scalar, one per axis (6,) or joint (dof,), or one per env as well, (envs, 6)
    or (envs, dof).

    Parameters
    ----------
    stiffness, damping_ratio, damping
        kp >= 0 [1/s^2] and kd = 2 zeta sqrt(kp), or kd itself [1/s], of the axes x, y, z, rx, ry,
        rz.
    integral_gain, integral_limit
        ki [1/s^3], which learns loads that the model does not know, and the largest size of the
        integral of each axis [m/s^2, rad/s^2]. A loop with kp and kd is stable for ki < kp kd.
        None: no integral.
    axes
        Bools: the axes whose motion is controlled; the posture moves the others. None: all.
    force_axes
        Bools: axes, not among ``axes``, that the wrench controls, and on which the posture does not
        act.
    posture_stiffness, posture_damping_ratio
        Gains of the joints towards their posture: within the null space of the task for the joints
        of the chain to the tool, fully for others, such as fingers [1/s^2]. Followers have none.
    limit_margin, limit_stiffness
        Joints of the chain that come nearer to a position limit than the margin [rad or m], or a
        quarter of their range, are pushed away within the null space, by a critically damped spring
        [1/s^2]. None: no margin.
    position_error_limit, rotation_error_limit
        Largest norm of the error that enters the law [m, rad]; inf for none.
    smallest_eigenvalue
        s0 > 0 of the bounded inverse (:mod:`batchpid.task_space.operational_space`): below it,
        directions near a singularity lose stiffness; below s0/5 the posture pulls the tool there
        [1/kg, 1/(kg m^2)].
    effort_limit, effort_min, effort_max
        Limits of the total effort of the joints [N m or N]: ``effort_limit=x`` is ``effort_min=-x,
        effort_max=x``.
    frame
        "world" or "tool": the axes of gains, selections and wrenches. Setpoints are in the world.
    discretization
        "explicit", or "implicit": stable at any time step
        (:mod:`batchpid.task_space.osc_state`).

    Raises
    ------
    InvalidArgumentError
        Naming the option, axis or joint, env and value.
    """
    check_masses(instance("tree", tree, RigidTree, MAKE_TREE))
    joints = tree.joint_names
    rows = _read(
        options,
        {
            "axis": AXES,
            "joint": joints,
            "norm": ("norm",),
            "s0": ("s0",),
        },
    )
    motion = rows["axes"]
    force = rows["force_axes"]
    if force is not None:
        both = force * (1.0 if motion is None else motion)
        entries(
            "force_axes",
            both > 0,
            both == 0,
            "is an axis of motion, too",
            AXES,
            kind="entry",
        )
    if rows["damping"] is None:
        rows["damping"] = 2 * rows["damping_ratio"] * np.sqrt(rows["stiffness"])
    # Critical damping and the like follow from the stiffness that is left.
    posture = rows["posture_stiffness"] * tree.coupling.independent
    rows["posture_stiffness"] = posture
    rows["posture_damping"] = 2 * rows["posture_damping_ratio"] * np.sqrt(posture)
    ends = {name: rows[name] for name in ("effort_limit", "effort_min", "effort_max")}
    rows["effort_min"], rows["effort_max"] = checked_ends(ends, joints)
    if rows["integral_gain"] is None:
        rows["integral_limit"] = None
    # Joints without limits that turn are angles modulo 2 pi for the posture. Followers have no
    # posture and no limits of their own: their leader has them.
    lower = np.array([tree.lower])
    upper = np.array([tree.upper])
    if rows["limit_margin"] is None:
        rows["limit_stiffness"] = None
    else:
        rows["limit_stiffness"] = rows["limit_stiffness"] * tree.coupling.independent
        rows["limit_margin"] = margin = np.minimum(rows["limit_margin"], (upper - lower) / 4)
        # A joint with a margin of 0 is pushed from nowhere: its ends lie at infinity.
        rows["limit_low"] = np.where(margin > 0, lower + margin, -np.inf)
        rows["limit_high"] = np.where(margin > 0, upper - margin, np.inf)
    endless = np.isinf(lower) & np.isinf(upper) & (tree.bodies.slides[:, 0] == 0)
    if endless.any():
        rows["turns"] = endless / TURN
    for name, chosen in {"frame": frame, "discretization": discretization}.items():
        rows[name] = TASK_CHOICES[name][choice(name, chosen, TASK_CHOICES[name])]
    return frozen(OSCParams(**{name: rows.get(name) for name in OSCParams._fields}))


def _read(options: Mapping[str, ArrayLike], columns: Mapping[str, tuple[str, ...]]) -> Document:
    """Return the rows of all options of OSC_FIELDS, with their defaults; None stays.

    Raises InvalidArgumentError for an option that is given, and has no effect.
    """
    rows: Document = {}
    envs = 1
    for name, field in OSC_FIELDS.items():
        names = columns[field.group]
        kind: AxisKind = "joint" if field.group == "joint" else "entry"
        builder = LeafBuilder(len(names), names, kind=kind)
        builder.num_envs = envs
        value: Any = options.get(name, field.default)
        if isinstance(field.neutral, bool) and value is not None:
            # Bools as 1.0 and 0.0.
            value = read_array(name, value, "b").astype(float)
            field = Field()
        if len(names) == 1 and np.ndim(value) == 1:  # one number for each env
            value = np.reshape(value, (-1, 1))
        rows[name] = builder.array(name, value, field)
        envs = builder.num_envs
    # An option without effect is nearly always a misunderstanding.
    for name, (other, is_given, reason) in WITHOUT_EFFECT.items():
        is_unused = (rows[other] is not None) == is_given
        if is_unused and (rows[name] != OSC_FIELDS[name].default).any():
            remedy = "leave it out, or correct the other option"
            raise InvalidArgumentError(name, f"has no effect: {reason}", remedy=remedy)
    return rows
