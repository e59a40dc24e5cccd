"""Results of exports and imports, and the differences between the law and a target, each with a figure.

Phases are taken from the sampled controller, from measurement to effort, with z = exp(j w dt)::

    C(z) = kp + ki dt / (z - 1) [output first], ki dt z / (z - 1) [integrate first] + kd F(z) R(z)
    F(z) = dt / (tau + dt - tau / z)        R(z) = (1 - 1/z) / dt [differences], j w [measured rate]

at the crossover of the loop with an inertia m of the joint alone, the largest w with |kp + ki/(j w) + j w kd| = m w^2.
With x = w^2 that is the largest root of m^2 x^3 - kd^2 x^2 + (2 kd ki - kp^2) x - ki^2 = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Array, Float64
from batchpid.arrays.choices import IntegrateFirst, MeasuredRate, PerMassMatrix
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
    """Text of a file for a target, and the differences of the target's law from :func:`batchpid.step`."""

    text: str
    differences: tuple[str, ...] = ()
    """One sentence each; empty where the target computes the same law."""


class Imported(NamedTuple):
    """Params, the names of their joints, and the differences of the law from the file."""

    params: PIDParams
    joint_names: list[str]
    differences: tuple[str, ...] = ()


class Differences(list[str]):
    """Sentences ``"option: difference"`` about params in effort units, for a target.

    ``params`` are those given, of one env, converted to efforts at ``inertia`` if they were per unit of it, and to the
    explicit law at ``dt`` if they were implicit; ``joints`` their names; ``dt`` the time step [s]. ``implicit``: the
    target integrates P and D implicitly, and takes gains of the implicit law as they are.
    """

    def __init__(
        self,
        params: PIDParams,
        joint_names: Sequence[str],
        dt: float,
        inertia: ArrayLike | None,
        implicit: bool = False,
    ) -> None:
        super().__init__()
        check_one_env(params)
        self.joints = names("joint_names", joint_names, params.num_joints)
        self.dt = time_step("dt", dt)
        params.check(1, self.joints)
        check_gain_units(params)
        self.inertia = None if inertia is None else _inertia(inertia, self.joints)
        self.params = self._in_efforts(params._replace(discretization=None) if implicit else self._explicit(params))

    def _explicit(self, params: PIDParams) -> PIDParams:
        """Return the params of the explicit law at this time step."""
        found = as_explicit(params, self.dt)
        if found is not params:
            with np.errstate(invalid="ignore"):
                share = np.where(params.kp > 0, found.kp / params.kp, 1.0)[0]
            text = f"gains of the explicit law at dt = {self.dt:g} s, for no other step: kp times {self.listed(share)}"
            if params.ki is not None and np.any(params.ki > 0):
                text += "; the integral takes the setpoint for the beginning of a step, a lead of dt times its rate"
            self.append(f"discretization: {text}")
        return found

    def _in_efforts(self, params: PIDParams) -> PIDParams:
        """Return the params with gains in effort units."""
        if params.gain_units is None:
            return params
        whole = isinstance(params.gain_units, PerMassMatrix)
        unit = "mass_matrix" if whole else "inertia"
        if self.inertia is None:
            remedy = "pass inertia=, the diagonal of the mass matrix, or gains in effort units"
            raise InvalidArgumentError("inertia", f"is missing for gains per {unit}", remedy=remedy)
        scale = self.inertia[0]
        scaled = ("kp", "ki", "kd", *(("integral_min", "integral_max") if whole else ()))
        leaves = {name: leaf * scale for name in scaled if (leaf := getattr(params, name)) is not None}
        leaves = {name: leaf.astype(params.dtype) for name, leaf in leaves.items()}
        text = f"gains per {unit} are efforts at one inertia: {self.listed(scale)} kg m^2 or kg"
        ratio = self.inertia / scale
        if len(ratio) > 1:
            text += f"; in other poses the inertia is {ratio.min():.3g} to {ratio.max():.3g} times that"
        self.append(f"gain_units: {text}{', and joints disturb each other' if whole else ''}")
        return params._replace(gain_units=None, **leaves)

    def value(self, option: str, off: float = 0.0) -> Float64:
        """Return an option of the params (joints,), ``off`` where it is off."""
        leaf = getattr(self.params, option)
        return np.full(len(self.joints), off) if leaf is None else _exact(leaf)[0]

    def listed(self, values: ArrayLike, where: Any = True) -> str:
        """Return one value for each joint of the mask ``where``, as text: one figure where all are the same."""
        chosen = np.broadcast_to(where, len(self.joints))
        texts = [
            (joint, f"{x:.4g}") for joint, x, yes in zip(self.joints, np.asarray(values), chosen, strict=True) if yes
        ]
        if chosen.all() and len({text for _, text in texts}) == 1:
            return texts[0][1]
        return ", ".join(f"{joint} {text}" for joint, text in texts)

    def listed_names(self, where: Any) -> str:
        """Return the names of the joints in the mask ``where``, as text."""
        return ", ".join(joint for joint, yes in zip(self.joints, where, strict=True) if yes)

    def lack(self, option: str, problem: str, off: float, unit: str = "") -> None:
        """Add an option that the target lacks, where it is on."""
        values = self.value(option, off)
        if (on := values != off).any():
            self.append(f"{option}: {problem}; here {self.listed(values, on)} {unit}".rstrip())

    def opening(self, title: str) -> str:
        """Return the comments that open a file: its title, and the differences."""
        lines = [f"{title}, generated by batchpid.", *(f"differs: {' '.join(each.split())}" for each in self)]
        return "".join(f"# {line}\n" for line in lines)

    def phase(self, target: PIDParams) -> str:
        """Return the phase that the target's law has more than this one, as text.

        It is empty without inertia, and where no crossover is below half the sampling rate.
        """
        if self.inertia is None:
            return ""
        w = self._crossover()
        sampled = w * self.dt < math.pi  # NaN is not
        if not sampled.any():
            return ""
        with np.errstate(all="ignore"):  # joints without gains have no crossover
            more = np.degrees(np.angle(self._response(target, w) / self._response(self.params, w)))
        worst = int(np.argmax(np.where(sampled, np.abs(more), -1.0)))
        at = f"crossover of {self.joints[worst]}, {w[worst] / (2 * math.pi):.3g} Hz"
        return f"; {more[worst]:+.2g} degrees of phase at the {at}"

    def degrees(self, delay: Float64) -> str:
        """Return the phase of a delay [s] (joints,) at the crossover, as text; empty without inertia."""
        if self.inertia is None:
            return ""
        lag = np.degrees(np.nan_to_num(self._crossover()) * delay)
        return f"; {lag.max():.2g} degrees of phase at the crossover of {self.joints[int(np.argmax(lag))]}"

    def _crossover(self) -> Float64:
        """Return the crossover of each joint [rad/s], NaN without gains."""
        assert self.inertia is not None
        gains = zip(*(self.value(name) for name in ("kp", "ki", "kd")), self.inertia[0], strict=True)
        found = []
        for p, i, d, m in gains:
            roots = np.roots([m**2, -(d**2), 2 * d * i - p**2, -(i**2)])
            found.append(max((x.real for x in roots if abs(x.imag) < 1e-9 * abs(x) and x.real > 0), default=math.nan))
        return np.sqrt(found)

    def _response(self, params: PIDParams, w: Float64) -> NDArray[np.complex128]:
        dt = self.dt
        p, i, d, tau = (
            np.zeros(1) if leaf is None else _exact(leaf)[0]
            for leaf in (params.kp, params.ki, params.kd, params.derivative_filter_time)
        )
        z = np.exp(1j * w * dt)
        integral = i * dt * (z if isinstance(params.integration, IntegrateFirst) else 1.0) / (z - 1)
        rate = 1j * w if isinstance(params.measurement_rate, MeasuredRate) else (1 - 1 / z) / dt
        return p + integral + d * rate * dt / (tau + dt - tau / z)


def strategies(params: PIDParams) -> list[str]:
    """Return the anti-windup strategy of each joint of params of one env, by the names of make_params."""
    return [str(each) for each in np.broadcast_to(params.options()["anti_windup"], (1, params.num_joints))[0]]


def plain(leaf: Array, joint: int) -> float:
    """Return the number of a joint with the fewest digits that read back as the same number of its dtype."""
    return float(str(leaf[0, joint]))


def _exact(leaf: Array) -> Float64:
    return np.asarray(leaf, np.float64)


def _inertia(inertia: ArrayLike, joints: list[str]) -> Float64:
    """Return inertias (poses, joints) > 0."""
    rows = np.atleast_2d(read_array("inertia", inertia)).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != len(joints) or not len(rows):
        remedy = f"pass ({len(joints)},), or (poses, {len(joints)}) with that of the gains first"
        raise InvalidArgumentError("inertia", f"has shape {rows.shape}", remedy=remedy)
    return at_least("inertia", rows, np.finfo(float).tiny, joints)
