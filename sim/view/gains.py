"""Gains of a group of robots, changed from the page while the robots move."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

import batchpid as bp
from batchpid.arrays.array_types import Float64
from batchpid.checks.validate import at_least, broadcast, choice, integer
from batchpid.errors import InvalidArgumentError
from batchpid.law.input_checks import DRIVE_LACKS
from batchpid.sim.options import RunnerOptions, default_params
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner_keywords import ControlMode

GAINS = ("kp", "ki", "kd", "derivative_filter_time", "setpoint_weight", "effort_limit")
"""Gains that can be changed."""
# Switching an option on or off would change the state of the law, so filter and weight are never quite off.
_OPTIONS = {
    "kp": (0.0, 0.0, np.inf),
    "ki": (0.0, 0.0, np.inf),
    "kd": (0.0, 0.0, np.inf),
    "derivative_filter_time": (0.0, 1e-6, np.inf),
    "setpoint_weight": (1.0, 0.0, 1 - 1e-9),
    "effort_min": (-np.inf, -np.inf, np.inf),
    "effort_max": (np.inf, -np.inf, np.inf),
}
"""Options of make_params behind the gains: the value where an option is off, and the range of values."""
_MAX_EFFORT = 1e3
"""Largest effort limit on a slider [N m or N]."""


class GroupGains:
    """Gains of one group. ``sets`` are params of one row by name; the group starts with the first."""

    def __init__(self, robot: Robot, sets: dict[str, bp.PIDParams], control: ControlMode = "pid") -> None:
        self._robot, self._lacks = robot, frozenset(DRIVE_LACKS if control == "drive" else ())
        self.sets = {name: self._adjustable(params) for name, params in sets.items()}
        """Params by name, with every option on that a slider sets."""
        self.params = next(iter(self.sets.values()))
        """Params in force."""

    @property
    def values(self) -> dict[str, Float64]:
        """Gains in force as options of make_params, (dof,) each."""
        return _values(self.params)

    def apply_set(self, name: str) -> None:
        """Use the params of a named set on every joint."""
        self.params = self.sets[choice("name", name, self.sets)]

    def set(self, gain: str, joint: int, value: ArrayLike) -> None:
        """Set one of :data:`GAINS` of a joint, a number >= 0; a drive has no filter and no setpoint weight."""
        if gain in self._lacks:
            raise InvalidArgumentError("gain", "is not available in a drive", value=gain, remedy="set kp, ki or kd")
        values, joint = self.values, integer("joint", joint, 0, self._robot.dof - 1)
        value = at_least(gain, broadcast(gain, value, (), "give one number"), 0.0, infinite=True)
        if choice("gain", gain, GAINS) == "effort_limit":
            values["effort_min"][joint], values["effort_max"][joint] = -value, value
        else:
            values[gain][joint] = np.clip(value, *_ends(self.params, gain))
        self.params = self._replaced(self.params, values)

    def slider_range(self, gain: str, joint: int) -> tuple[float, float]:
        """Return a gain of a joint, and the upper end of the range worth trying."""
        name = "effort_max" if gain == "effort_limit" else choice("gain", gain, GAINS)
        value, units = float(self.values[name][joint]), type(self.params.gain_units)
        same_units = [params for params in self.sets.values() if isinstance(params.gain_units, units)]
        largest = max(float(_values(params)[name][joint]) for params in same_units)
        if gain == "effort_limit":
            return min(value, _MAX_EFFORT), min(float(self._robot.effort_limit[joint]), _MAX_EFFORT)
        ends = {"setpoint_weight": 1.0, "derivative_filter_time": max(0.02, largest)}
        return value, ends.get(gain, 4 * largest or float(self.values["kp"][joint]) or 1.0)

    def params_under(self, disturbance: Float64) -> bp.PIDParams:
        """Return params for a feedforward of ``disturbance`` (envs, dof) [N m or N] that acts from outside.

        The effort limits move with it, so that they bound the effort of the motors alone.
        """
        values = self.values
        return self.params.replace(**{end: disturbance + values[end] for end in ("effort_min", "effort_max")})

    def _adjustable(self, params: bp.PIDParams) -> bp.PIDParams:
        """Return ``params`` with every option on that a slider sets."""
        return self._replaced(params, _values(params))

    def _replaced(self, params: bp.PIDParams, values: dict[str, Float64]) -> bp.PIDParams:
        return params.replace(**{name: value for name, value in values.items() if name not in self._lacks})


def offered_gains(robot: Robot, control: ControlMode, params: bp.PIDParams | None) -> dict[str, bp.PIDParams]:
    """Return the gain sets that the page offers for a control, by name; the first is in force at the start.

    For the PID: the given ``params``, then the tuned, designed and tutorial gains as far as the robot has them.

    Raises
    ------
    InvalidArgumentError
        ``params`` are not one row of gains for the joints of ``robot``.
    """
    if control == "drive":
        return {"designed" if robot.settings is None else "tutorial": default_params(robot, control)}
    sets = {} if params is None else {"given": RunnerOptions(robot, 1, params=params).params}
    for name, make in (("tuned", robot.tuned), ("designed", robot.designed), ("tutorial", robot.params)):
        with suppress(InvalidArgumentError):  # not every robot has them
            sets[name] = make()
    return sets or {"designed": default_params(robot, control)}


def _values(params: bp.PIDParams) -> dict[str, Float64]:
    """Return the options behind the gains of ``params``, (dof,) each."""
    leaves = {name: getattr(params, name) for name in _OPTIONS}
    return {
        name: np.clip(
            np.full(params.num_joints, off) if leaves[name] is None else leaves[name][0], *_ends(params, name)
        )
        for name, (off, *_) in _OPTIONS.items()
    }


def _ends(params: bp.PIDParams, option: str) -> tuple[float, float]:
    """Return the range of an option's values; the implicit law has no filter."""
    has_none = option == "derivative_filter_time" and params.discretization is not None
    return (0.0, 0.0) if has_none else _OPTIONS[option][1:]
