"""Results of exports, and the differences between the law and a target, with the figures of this
law.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Array, Bool, Document, Float64
from batchpid.checks.validate import at_least, instance, names, read_array, time_step
from batchpid.errors import InvalidArgumentError
from batchpid.law.anti_windup import named
from batchpid.law.computed_torque import check_gain_units
from batchpid.law.implicit import as_explicit
from batchpid.law.params import PIDParams


def check_one_env(params: PIDParams) -> None:
    """Raise InvalidArgumentError unless these are params of one env."""
    instance("params", params, PIDParams, "build them with make_params()")
    if params.num_envs > 1:
        remedy = "choose one env: params.for_envs(slice(k, k + 1))"
        raise InvalidArgumentError("params", f"are for {params.num_envs} envs", remedy=remedy)


class Exported(NamedTuple):
    """Text of a file for a target, and the differences of the target's law from
    :func:`batchpid.step`.
    """

    text: str
    differences: tuple[str, ...] = ()
    """One sentence each; empty where the target computes the same law."""


class Differences(list[str]):
    """Sentences ``"option: difference"`` about params in effort units, for a target.

    ``params`` are those given, of one env, converted to efforts at ``inertia`` if they were per
    unit of it, and to the explicit law at ``dt`` if they were implicit; ``joints`` their names;
    ``dt`` the time step [s].
    """

    def __init__(
        self, params: PIDParams, joint_names: Sequence[str], dt: float, inertia: ArrayLike | None
    ) -> None:
        super().__init__()
        check_one_env(params)
        self.joints = names("joint_names", joint_names, params.num_joints)
        self.dt = time_step("dt", dt)
        params.check(1, self.joints)
        check_gain_units(params)
        self.params = self._in_efforts(self._explicit(params), inertia)

    def _explicit(self, params: PIDParams) -> PIDParams:
        """Return the params of the explicit law at this time step."""
        # No target has the implicit law, but all can have its gains at one time step.
        explicit = as_explicit(params, self.dt)
        if explicit is not params:
            share = explicit.kp[0] / np.where(params.kp[0] > 0, params.kp[0], np.inf)
            text = f"gains of the explicit law at dt = {self.dt:g} s, for no other step: kp times"
            text = f"{text} {self.listed(np.where(params.kp[0] > 0, share, 1.0))}"
            if params.ki is not None and np.any(params.ki > 0):
                text += "; the integral takes the setpoint for the beginning of a step, a lead of"
                text += " dt times its rate"
            self.append(f"discretization: {text}")
        return explicit

    def _in_efforts(self, params: PIDParams, inertia: ArrayLike | None) -> PIDParams:
        """Return the params with gains in effort units."""
        if inertia is None:
            poses = None
        else:
            poses = _inertia(inertia, self.joints)
        if params.gain_units is None:
            return params
        if poses is None:
            problem = "is missing for gains per mass_matrix"
            remedy = "pass inertia=, the diagonal of the mass matrix, or gains in effort units"
            raise InvalidArgumentError("inertia", problem, remedy=remedy)
        # The gains fit the first pose; the others show how far they are off elsewhere.
        ratio = poses / poses[0]
        text = f"gains per mass_matrix are efforts at one inertia: {self.listed(poses[0])} kg m^2"
        text += " or kg"
        if len(ratio) > 1:
            ends = f"{ratio.min():.3g} to {ratio.max():.3g}"
            text += f"; in other poses the inertia is {ends} times that"
        self.append(f"gain_units: {text}, and joints disturb each other")
        scaled: Document = {"gain_units": None}
        for name, leaf in params.leaves().items():
            if name in ("kp", "ki", "kd", "integral_min", "integral_max"):
                scaled[name] = (leaf * poses[0]).astype(params.dtype)
        return params._replace(**scaled)

    def value(self, option: str, off: float = 0.0) -> Float64:
        """Return an option of the params (joints,), ``off`` where it is off."""
        return joint_values(getattr(self.params, option), len(self.joints), off)

    def ends(self, limit: str) -> tuple[Float64, Float64]:
        """Return the lower and the upper limit (joints,) of the "effort" or the "integral"."""
        return self.value(f"{limit}_min", -math.inf), self.value(f"{limit}_max", math.inf)

    @property
    def limited(self) -> Bool:
        """Mask of the joints with an effort limit."""
        low, high = self.ends("effort")
        return np.isfinite(low) | np.isfinite(high)

    def listed(self, values: ArrayLike, where: ArrayLike = True) -> str:
        """Return one value for each joint of the mask ``where``, as text: one figure where all are
        the same.
        """
        chosen = np.broadcast_to(where, len(self.joints))
        texts = [f"{value:.4g}" for value in np.asarray(values)]
        if chosen.all() and len(set(texts)) == 1:
            return texts[0]
        named = [f"{joint} {text}" for joint, text in zip(self.joints, texts, strict=True)]
        return ", ".join(np.array(named)[chosen])

    def listed_names(self, where: Bool) -> str:
        """Return the names of the joints in the mask ``where``, as text."""
        return ", ".join(np.array(self.joints)[where])

    def add(
        self,
        option: str,
        problem: str,
        where: ArrayLike,
        values: ArrayLike | None = None,
        unit: str = "",
    ) -> None:
        """Add a difference of ``option``, if any joint is in the mask ``where``, with this law's
        ``values`` there.
        """
        if np.any(where):
            figures = ""
            if values is not None:
                figures = f"; here {self.listed(values, where)} {unit}".rstrip()
            self.append(f"{option}: {problem}{figures}")

    def lack(self, option: str, problem: str, off: float, unit: str = "") -> None:
        """Add an option that the target lacks, where it is on."""
        values = self.value(option, off)
        self.add(option, problem, values != off, values, unit)

    def lack_weights(self) -> None:
        """Add the limit of the effort's rate and the weight of the setpoint in P."""
        text = "the change of the effort is not limited"
        self.lack("effort_rate_limit", text, math.inf, "N m/s or N/s")
        text = "P acts on the whole setpoint (b = 1), so steps overshoot more"
        self.lack("setpoint_weight", text, 1.0)

    def opening(self, title: str) -> str:
        """Return the comments that open a file: its title, and the differences."""
        lines = [f"# {title}, generated by batchpid.\n"]
        lines += [f"# differs: {' '.join(sentence.split())}\n" for sentence in self]
        return "".join(lines)


def joint_values(leaf: Array, joints: int, off: float) -> Float64:
    """Return a leaf of one env (joints,), ``off`` where it is None."""
    if leaf is None:
        return np.full(joints, off)
    return np.asarray(leaf[0], np.float64)


def strategies(params: PIDParams) -> list[str]:
    """Return the anti-windup strategy of each joint of params of one env, by the names of
    make_params.
    """
    names = named(params.num_joints, params.tracking_time, params.conditional)
    return [str(name) for name in names[0]]


def _inertia(inertia: ArrayLike, joints: list[str]) -> Float64:
    """Return inertias (poses, joints) > 0."""
    rows = np.atleast_2d(read_array("inertia", inertia)).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != len(joints) or not len(rows):
        remedy = f"pass ({len(joints)},), or (poses, {len(joints)}) with that of the gains first"
        raise InvalidArgumentError("inertia", f"has shape {rows.shape}", remedy=remedy)
    return at_least("inertia", rows, np.finfo(float).tiny, joints)
