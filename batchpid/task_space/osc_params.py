"""Parameters of operational-space control: build, broadcast, validate."""

from __future__ import annotations

import math
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Array, Document
from batchpid.arrays.choices import CHOICES, NamedChoice
from batchpid.arrays.display import array_summary
from batchpid.arrays.elementwise import TURN
from batchpid.arrays.field_tables import Field, declared
from batchpid.arrays.leaves import checked_ends
from batchpid.checks.validate import (
    AxisKind,
    array,
    choice,
    entries,
    instance,
    known_keywords,
    read_array,
)
from batchpid.errors import InvalidArgumentError
from batchpid.task_space.rigid_tree import MAKE_TREE, RigidTree
from batchpid.task_space.tree_dynamics import check_masses

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


class OSCParams(NamedTuple):
    """Parameters of operational-space control, for one tool of one kind of robot. Build it with
    :func:`make_osc_params`.

    Every leaf is a float64 array of one row or one per env; None is off.
    """

    stiffness: Array
    """kp (1 | envs, 6) [1/s^2]."""
    damping: Array
    """kd (1 | envs, 6) [1/s]."""
    posture_stiffness: Array
    """(1 | envs, dof) [1/s^2]."""
    posture_damping: Array
    """(1 | envs, dof) [1/s]."""
    position_error_limit: Array
    """(1 | envs, 1) [m]."""
    rotation_error_limit: Array
    """(1 | envs, 1) [rad]."""
    smallest_eigenvalue: Array
    """s0 (1 | envs, 1) [1/kg, 1/(kg m^2)]."""
    axes: Any = None
    """1.0 for the axes whose motion is controlled (1 | envs, 6); None for all."""
    force_axes: Any = None
    """1.0 for further axes that the posture must not act on (1 | envs, 6)."""
    effort_min: Array = None
    """(1 | envs, dof) [N m or N]."""
    effort_max: Array = None
    frame: Any = None
    """None for "world", or a choice without fields."""
    integral_gain: Array = None
    """ki (1 | envs, 6) [1/s^3]."""
    integral_limit: Array = None
    """(1 | envs, 6) [m/s^2, rad/s^2]."""
    limit_stiffness: Array = None
    """(1 | envs, dof) [1/s^2]."""
    limit_margin: Array = None
    """(1 | envs, dof) [rad or m]."""
    lower: Array = None
    """Position limits of the tree (1, dof) [rad or m]; None without ``limit_margin``."""
    upper: Array = None
    turns: Array = None
    """1 / (2 pi) for joints of the tree that turn without limits, whose posture is the one next to
    qpos, else 0 (1, dof); None without such joints.
    """
    discretization: Any = None
    """ImplicitLaw(): the gains act on the predicted end of the step; None: on its beginning."""

    def __repr__(self) -> str:
        return array_summary(self, "envs", "axes")


@known_keywords
def make_osc_params(
    tree: RigidTree,
    *,
    stiffness: Annotated[ArrayLike, Field("1/s^2")] = 150.0,
    damping_ratio: Annotated[ArrayLike, Field("1", 1.0)] = 1.0,
    damping: Annotated[ArrayLike | None, Field("1/s")] = None,
    integral_gain: Annotated[ArrayLike | None, Field("1/s^3")] = None,
    integral_limit: Annotated[ArrayLike, Field("m/s^2 or rad/s^2", math.inf)] = math.inf,
    axes: Annotated[ArrayLike | None, Field(neutral=True)] = None,
    force_axes: Annotated[ArrayLike | None, Field(neutral=False)] = None,
    posture_stiffness: Annotated[ArrayLike, Field("1/s^2", group="joint")] = 10.0,
    posture_damping_ratio: Annotated[ArrayLike, Field("1", 1.0, group="joint")] = 1.0,
    limit_margin: Annotated[ArrayLike | None, Field("rad or m", group="joint")] = None,
    limit_stiffness: Annotated[ArrayLike, Field("1/s^2", group="joint")] = 400.0,
    position_error_limit: Annotated[ArrayLike, Field("m", math.inf, above=True)] = 0.1,
    rotation_error_limit: Annotated[ArrayLike, Field("rad", math.inf, above=True)] = 0.5,
    smallest_eigenvalue: Annotated[ArrayLike, Field("1/kg or 1/(kg m^2)", above=True)] = 0.02,
    effort_limit: Annotated[ArrayLike | None, Field("N m or N", math.inf, group="joint")] = None,
    effort_min: Annotated[
        ArrayLike | None, Field("N m or N", -math.inf, low=-math.inf, group="joint")
    ] = None,
    effort_max: Annotated[
        ArrayLike | None, Field("N m or N", math.inf, low=-math.inf, group="joint")
    ] = None,
    frame: str = "world",
    discretization: str = "explicit",
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
        s0 > 0 of the bounded inverse (:func:`batchpid.task_space.symmetric.bounded_inverse`): below
        it, directions near a singularity lose stiffness; below s0/5 the posture pulls the tool
        there [1/kg, 1/(kg m^2)].
    effort_limit, effort_min, effort_max
        Limits of the total effort of the joints [N m or N]: ``effort_limit=x`` is ``effort_min=-x,
        effort_max=x``.
    frame
        "world" or "tool": the axes of gains, selections and wrenches. Setpoints are in the world.
    discretization
        "explicit", or "implicit": stable at any time step
        (:mod:`batchpid.task_space.osc_coefficients`).

    Raises
    ------
    InvalidArgumentError
        Naming the option, axis or joint, env and value.
    """
    check_masses(instance("tree", tree, RigidTree, MAKE_TREE))
    joints = tree.joint_names
    # An option without effect is an error: it is nearly always a misunderstanding.
    _check_unused("damping_ratio", damping_ratio, 1.0, damping is not None, "damping is given, too")
    _check_unused(
        "integral_limit",
        integral_limit,
        math.inf,
        integral_gain is None,
        "integral_gain is not given",
    )
    _check_unused(
        "limit_stiffness", limit_stiffness, 400.0, limit_margin is None, "limit_margin is not given"
    )
    kp = _rows("stiffness", stiffness, AXES)
    kd = 2 * _rows("damping_ratio", damping_ratio, AXES) * np.sqrt(kp)
    posture = _rows("posture_stiffness", posture_stiffness, joints) * tree.independent
    motion, force = (
        _mask(name, value) for name, value in (("axes", axes), ("force_axes", force_axes))
    )
    if force is not None:
        both = force * (np.ones((1, 6)) if motion is None else motion)
        entries("force_axes", both > 0, both == 0, "is an axis of motion, too", AXES, kind="entry")
    given = {"effort_limit": effort_limit, "effort_min": effort_min, "effort_max": effort_max}
    efforts = {
        name: None if rows is None else _rows(name, rows, joints) for name, rows in given.items()
    }
    low, high = checked_ends(efforts, joints)
    # Joints without limits that turn are angles modulo 2 pi for the posture. Followers have no
    # posture and no limits of their own: their leader has them.
    limits, own = np.array([tree.lower, tree.upper]), tree.independent
    endless = np.isinf(limits).all(0) & (tree.bodies.slides[:, 0] == 0)
    margin = None if limit_margin is None else _rows("limit_margin", limit_margin, joints)
    integral = None if integral_gain is None else _rows("integral_gain", integral_gain, AXES)
    params = OSCParams(
        stiffness=kp,
        damping=kd if damping is None else _rows("damping", damping, AXES),
        posture_stiffness=posture,
        posture_damping=2
        * _rows("posture_damping_ratio", posture_damping_ratio, joints)
        * np.sqrt(posture),
        position_error_limit=_rows("position_error_limit", position_error_limit, ("norm",)),
        rotation_error_limit=_rows("rotation_error_limit", rotation_error_limit, ("norm",)),
        smallest_eigenvalue=_rows("smallest_eigenvalue", smallest_eigenvalue, ("s0",)),
        axes=motion,
        force_axes=force,
        effort_min=low,
        effort_max=high,
        frame=TASK_CHOICES["frame"][choice("frame", frame, TASK_CHOICES["frame"])],
        integral_gain=integral,
        integral_limit=None if integral is None else _rows("integral_limit", integral_limit, AXES),
        limit_stiffness=(
            None if margin is None else _rows("limit_stiffness", limit_stiffness, joints) * own
        ),
        limit_margin=None if margin is None else np.minimum(margin, (limits[1:] - limits[:1]) / 4),
        lower=None if margin is None else limits[:1],
        upper=None if margin is None else limits[1:],
        turns=(endless / TURN)[None] if endless.any() else None,
        discretization=TASK_CHOICES["discretization"][
            choice("discretization", discretization, TASK_CHOICES["discretization"])
        ],
    )
    _check_rows(params)
    return params


FIELDS = declared(make_osc_params, Field)
"""Options that are numbers."""


def _rows(name: str, value: ArrayLike, columns: tuple[str, ...]) -> NDArray[np.float64]:
    """Return ``value`` as read-only rows (1 | envs, columns) within the bounds of its field."""
    given = read_array(name, value)
    shape = (len(given) if given.ndim == 2 else 1, len(columns))
    if len(columns) == 1 and given.ndim == 1:  # one number per env
        given = given[:, None]
        shape = given.shape
    kind: AxisKind = "joint" if FIELDS[name].group == "joint" else "entry"
    rows = array(name, given, shape, columns, finite=False, kind=kind).copy()
    FIELDS[name].checked(name, rows, columns, kind=kind)
    rows.setflags(write=False)
    return rows


def _check_unused(name: str, value: ArrayLike, default: float, unused: bool, reason: str) -> None:
    """Raise InvalidArgumentError for an option that is given, and has no effect."""
    if unused and (read_array(name, value) != default).any():
        raise InvalidArgumentError(
            name, f"has no effect: {reason}", remedy="leave it out, or correct the other option"
        )


def _mask(name: str, value: ArrayLike | None) -> NDArray[np.float64] | None:
    """Return a mask of axes as read-only rows of 1.0 and 0.0; None where it is left out."""
    return None if value is None else _rows(name, read_array(name, value, "b").astype(float), AXES)


def _check_rows(params: OSCParams) -> None:
    """Raise InvalidArgumentError if options have rows for different numbers of envs."""
    most = max(
        (leaf.shape[0], name)
        for name, leaf in params._asdict().items()
        if isinstance(leaf, np.ndarray)
    )
    for name, leaf in params._asdict().items():
        if isinstance(leaf, np.ndarray) and leaf.shape[0] not in (1, most[0]):
            problem = f"has rows for {leaf.shape[0]} envs, but {most[1]} for {most[0]}"
            raise InvalidArgumentError(name, problem, remedy="give one row, or one for each env")
