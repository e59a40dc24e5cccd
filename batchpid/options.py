"""From what a caller gives for an option to the leaf that the law reads: checked, broadcast and frozen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from batchpid.choices import CHOICES
from batchpid.errors import InvalidArgumentError

ANTI_WINDUP = ("none", "clamp", "conditional", "back_calculation")


class LeafBuilder:
    """Turns what the caller gave into canonical arrays, and complaints into errors that name the culprit."""

    def __init__(self, joints: int, joint_names: Sequence[str] | None, dtype: Any) -> None:
        if isinstance(joints, bool) or not isinstance(joints, int | np.integer) or joints < 1:
            raise InvalidArgumentError(
                "joints", "is not a whole number >= 1", value=joints, remedy="give the number of joints"
            )
        if joint_names is not None and not isinstance(joint_names, list | tuple):
            raise InvalidArgumentError(
                "joint_names", "is no list of names", value=joint_names, remedy="name every joint once"
            )
        if joint_names is not None and len(joint_names) != joints:
            raise InvalidArgumentError(
                "joint_names",
                f"names {len(joint_names)} joints, not {joints}",
                remedy="name every joint once",
            )
        self.joints, self.names = int(joints), joint_names
        try:
            self.dtype = np.dtype(dtype)
        except TypeError:
            self.dtype = np.dtype(object)
        if self.dtype not in (np.float32, np.float64):
            raise InvalidArgumentError(
                "dtype", "is neither float32 nor float64", value=str(dtype), remedy="choose one of them"
            )
        self.num_envs = 1

    def array(self, name: str, value: Any, low: float, high: float = math.nan, above: bool = False) -> Any:
        """Return ``value`` as (1 | envs, joints) with every entry in [low, high]; ``high`` NaN: finite only."""
        if value is None:
            return None
        try:
            array = np.asarray(value)
            if array.dtype.kind not in "iuf":
                raise TypeError
            array = array.astype(self.dtype)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            raise InvalidArgumentError(
                name, "is not made of real numbers", value=value, remedy="give numbers"
            ) from None
        array = self._canonical(name, array)
        within = np.isfinite(array) if math.isnan(high) else array <= high
        within &= (array > low) if above else (array >= low)
        if not within.all():
            env, joint = (int(n) for n in np.argwhere(~within)[0])
            bounds = f"{'>' if above else '>='} {low:g}" if math.isfinite(low) else "a number"
            raise InvalidArgumentError(
                name,
                f"must be {'finite and ' if math.isnan(high) else ''}{bounds}",
                joint=self.names[joint] if self.names is not None else joint,
                env=env if array.shape[0] > 1 else None,
                value=float(array[env, joint]),
                remedy="correct that entry",
            )
        return array

    def option(self, name: str, value: Any, *, neutral: float, above: bool = False) -> Any:
        """Return an option's leaf: None where it is ``neutral`` on every joint of every env."""
        array = self.array(name, value, 0.0, math.inf if math.isinf(neutral) else math.nan, above)
        return None if array is None or (array == neutral).all() else self.freeze(array)

    def limits(self, name: str, symmetric: Any, low: Any, high: Any) -> tuple[Any, Any]:
        """Return the leaves of a lower and an upper limit, each None where it is infinite everywhere."""
        if symmetric is not None:
            if low is not None or high is not None:
                raise InvalidArgumentError(
                    f"{name}_limit",
                    f"is given together with {name}_min or {name}_max",
                    remedy="give the symmetric limit, or the two ends",
                )
            upper = self.array(f"{name}_limit", symmetric, 0.0, math.inf)
            lower = -upper
        else:
            lower = self.array(f"{name}_min", low, -math.inf, math.inf)
            upper = self.array(f"{name}_max", high, -math.inf, math.inf)
        if lower is not None and upper is not None and not (lower <= upper).all():
            env, joint = (int(n) for n in np.argwhere(~(lower <= upper))[0])
            raise InvalidArgumentError(
                f"{name}_min",
                f"exceeds {name}_max",
                joint=self.names[joint] if self.names is not None else joint,
                env=env if max(lower.shape[0], upper.shape[0]) > 1 else None,
                remedy="swap or correct them",
            )
        lower = None if lower is None or np.isneginf(lower).all() else lower
        upper = None if upper is None or np.isposinf(upper).all() else upper
        return lower, upper

    def mask(self, name: str, value: Any) -> Any:
        """Return a mask of 1.0 and 0.0, None where it is False everywhere."""
        if value is None:
            return None
        try:
            array = np.asarray(value)
        except (TypeError, ValueError, RuntimeError):
            array = np.zeros(0)  # no bools either
        if array.dtype.kind != "b":
            raise InvalidArgumentError(name, "is not made of bools", value=value, remedy="give True or False")
        array = self._canonical(name, array)
        return array.astype(self.dtype) if array.any() else None

    def strategies(self, value: Any) -> tuple[Any, Any, Any]:
        """Return the masks of clamp, conditional and back-calculation, each None where no joint has it."""
        try:
            array = np.asarray(value, dtype=object)
        except (TypeError, ValueError, RuntimeError) as error:
            raise InvalidArgumentError(
                "anti_windup", f"is no array: {error}", remedy=f"choose from {', '.join(ANTI_WINDUP)}"
            ) from None
        array = self._canonical("anti_windup", array)
        for env, joint in np.ndindex(array.shape):
            if not isinstance(array[env, joint], str) or array[env, joint] not in ANTI_WINDUP:
                raise InvalidArgumentError(
                    "anti_windup",
                    "is no known strategy",
                    joint=self.names[joint] if self.names is not None else joint,
                    env=env if array.shape[0] > 1 else None,
                    value=array[env, joint],
                    remedy=f"choose from {', '.join(ANTI_WINDUP)}",
                )
        masks = (array == strategy for strategy in ANTI_WINDUP[1:])
        clamp, conditional, back = (mask if mask.any() else None for mask in masks)
        return clamp, conditional, back

    def choice(self, name: str, chosen: Any) -> Any:
        """Return the marker of a named choice."""
        if not isinstance(chosen, str) or chosen not in CHOICES[name]:
            raise InvalidArgumentError(
                name, "is no known choice", value=chosen, remedy=f"choose from {', '.join(CHOICES[name])}"
            )
        return CHOICES[name][chosen]

    def freeze(self, array: Any) -> Any:
        """Return the leaf in the params' dtype and read-only: params are values, to be replaced and not edited."""
        if array is None:
            return None
        leaf = np.array(array, dtype=self.dtype)
        leaf.setflags(write=False)
        return leaf

    def _canonical(self, name: str, array: Any) -> Any:
        """Return a scalar, (joints,) or (envs, joints) as (1 | envs, joints)."""
        if array.ndim <= 1 and array.size and array.shape in ((), (1,), (self.joints,)):
            return np.broadcast_to(array, (1, self.joints)).copy()
        if array.ndim == 2 and array.shape[1] in (1, self.joints) and array.shape[0] >= 1:
            envs = array.shape[0]
            if envs == 1 or self.num_envs in (1, envs):
                self.num_envs = max(self.num_envs, envs)
                return np.broadcast_to(array, (envs, self.joints)).copy()
            expected = f"({self.num_envs}, {self.joints}), as another option has it"
        else:
            expected = f"(), ({self.joints},) or (envs, {self.joints})"
        raise InvalidArgumentError(
            name,
            f"has shape {array.shape}, not {expected}",
            remedy="give a value for all, per joint, or per env and joint",
        )
