"""Results of exports, and the differences between the law and a target, with the figures of this
law.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from batchpid.arrays.array_types import Array, Float64
from batchpid.checks.validate import at_least, instance, names, read_array, time_step
from batchpid.errors import InvalidArgumentError
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
        explicit = as_explicit(params, self.dt)
        if explicit is not params:
            with np.errstate(invalid="ignore"):
                share = np.where(params.kp > 0, explicit.kp / params.kp, 1.0)[0]
            text = (
                f"gains of the explicit law at dt = {self.dt:g} s, for no other step: kp times"
                f" {self.listed(share)}"
            )
            if params.ki is not None and np.any(params.ki > 0):
                text += (
                    "; the integral takes the setpoint for the beginning of a step, a lead of dt"
                    " times its rate"
                )
            self.append(f"discretization: {text}")
        return explicit

    def _in_efforts(self, params: PIDParams, inertia: ArrayLike | None) -> PIDParams:
        """Return the params with gains in effort units."""
        poses = None if inertia is None else _inertia(inertia, self.joints)
        if params.gain_units is None:
            return params
        if poses is None:
            remedy = "pass inertia=, the diagonal of the mass matrix, or gains in effort units"
            raise InvalidArgumentError(
                "inertia", "is missing for gains per mass_matrix", remedy=remedy
            )
        scale = poses[0]
        leaves = {}
        for name in ("kp", "ki", "kd", "integral_min", "integral_max"):
            leaf = getattr(params, name)
            if leaf is not None:
                leaves[name] = (leaf * scale).astype(params.dtype)
        text = (
            f"gains per mass_matrix are efforts at one inertia: {self.listed(scale)} kg m^2 or kg"
        )
        ratio = poses / scale
        if len(ratio) > 1:
            text += (
                f"; in other poses the inertia is {ratio.min():.3g} to {ratio.max():.3g} times that"
            )
        self.append(f"gain_units: {text}, and joints disturb each other")
        return params._replace(gain_units=None, **leaves)

    def value(self, option: str, off: float = 0.0) -> Float64:
        """Return an option of the params (joints,), ``off`` where it is off."""
        leaf = getattr(self.params, option)
        return np.full(len(self.joints), off) if leaf is None else np.asarray(leaf, np.float64)[0]

    def listed(self, values: ArrayLike, where: Any = True) -> str:
        """Return one value for each joint of the mask ``where``, as text: one figure where all are
        the same.
        """
        chosen = np.broadcast_to(where, len(self.joints))
        texts = [
            (joint, f"{x:.4g}")
            for joint, x, yes in zip(self.joints, np.asarray(values), chosen, strict=True)
            if yes
        ]
        if chosen.all() and len({text for _, text in texts}) == 1:
            return texts[0][1]
        return ", ".join(f"{joint} {text}" for joint, text in texts)

    def listed_names(self, where: Any) -> str:
        """Return the names of the joints in the mask ``where``, as text."""
        return ", ".join(joint for joint, yes in zip(self.joints, where, strict=True) if yes)

    def add(
        self, option: str, problem: str, where: Any, values: Any = None, unit: str = ""
    ) -> None:
        """Add a difference of ``option``, if any joint is in the mask ``where``, with this law's
        ``values`` there.
        """
        if np.any(where):
            figures = (
                "" if values is None else f"; here {self.listed(values, where)} {unit}".rstrip()
            )
            self.append(f"{option}: {problem}{figures}")

    def lack(self, option: str, problem: str, off: float, unit: str = "") -> None:
        """Add an option that the target lacks, where it is on."""
        values = self.value(option, off)
        self.add(option, problem, values != off, values, unit)

    def opening(self, title: str) -> str:
        """Return the comments that open a file: its title, and the differences."""
        lines = [
            f"{title}, generated by batchpid.",
            *(f"differs: {' '.join(each.split())}" for each in self),
        ]
        return "".join(f"# {line}\n" for line in lines)


def strategies(params: PIDParams) -> list[str]:
    """Return the anti-windup strategy of each joint of params of one env, by the names of
    make_params.
    """
    return [
        str(each)
        for each in np.broadcast_to(params.options()["anti_windup"], (1, params.num_joints))[0]
    ]


def plain(leaf: Array, joint: int) -> float:
    """Return the number of a joint with the fewest digits that read back as the same number of its
    dtype.
    """
    return float(str(leaf[0, joint]))


def _inertia(inertia: ArrayLike, joints: list[str]) -> Float64:
    """Return inertias (poses, joints) > 0."""
    rows = np.atleast_2d(read_array("inertia", inertia)).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != len(joints) or not len(rows):
        remedy = f"pass ({len(joints)},), or (poses, {len(joints)}) with that of the gains first"
        raise InvalidArgumentError("inertia", f"has shape {rows.shape}", remedy=remedy)
    return at_least("inertia", rows, np.finfo(float).tiny, joints)
