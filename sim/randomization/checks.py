"""Checks of a randomization: its names, and the range of what can result from its draws."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Rows
from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError
from batchpid.motors import DRIVEN
from batchpid.motors.actuators import FIELDS, TABLE
from batchpid.sim.randomization.fields import Field, elements, nominal_values, parts
from batchpid.sim.randomization.randomization import EVENTS, PHYSICAL, START, Randomization
from batchpid.sim.robot.parts import MjcfFile
from batchpid.sim.robot.robot import Robot

_HUGE = 1e300


def check_robot(randomization: Randomization, robot: Robot, mjcf: MjcfFile | None = None) -> None:
    """Check that the names and ranges of ``randomization`` fit ``robot``. Raises InvalidArgumentError if not.

    ``mjcf`` as for :func:`batchpid.sim.randomization.fields.nominal_values`.
    """
    for name, each in randomization.given.items():
        if name in PHYSICAL:
            _check_range(name, each, robot, mjcf)
        elif name in START:
            list(parts(name, each, robot.joint_names))
    _check_pushes(randomization, robot)
    if randomization.damping is not None and robot.dissipation != "urdf":
        remedy = "load the robot with dissipation='urdf'"
        raise InvalidArgumentError(
            "damping", "cannot be drawn: the engine sets it with this dissipation", remedy=remedy
        )
    if randomization.payload_link is not None:
        choice("payload_link", randomization.payload_link, [link.name for link in robot.links])


def _check_pushes(randomization: Randomization, robot: Robot) -> None:
    """Check that pushes have intervals, longer than 0, and that the base floats."""
    events = randomization.events
    if not events:
        return
    for name in EVENTS:
        if name not in events:
            other = next(iter(events))
            raise InvalidArgumentError(name, f"is missing, and there is a {other}", remedy="give both, or none")
    if robot.fixed_base:
        remedy = "load it with fixed_base=False"
        raise InvalidArgumentError("push", f"needs a floating base, which {robot.name!r} does not have", remedy=remedy)
    list(parts("push", events["push"], elements("push", robot)))
    interval, push = randomization.push_interval, events["push"]
    assert interval is not None
    if any(each.operation == "scale" for each in (interval, *(push.values() if isinstance(push, Mapping) else [push]))):
        problem, remedy = "and push_interval have no nominal value that could be scaled", "leave out the operation"
        raise InvalidArgumentError("push", problem, remedy=remedy)
    if not interval.support[0] > 0:
        problem = f"may become {interval.support[0]:.3g}, but must be > 0"
        raise InvalidArgumentError("push_interval", problem, value=interval.to_dict(), remedy="change the bounds")


def check_params(randomization: Randomization, params: bp.PIDParams, robot: Robot) -> None:
    """Check that the params have the leaves that are drawn, and that no draw makes them invalid.

    Raises InvalidArgumentError if a leaf is off, or a draw may be out of its range.
    """
    for leaf, each in randomization.params.items():
        name = f"params.{leaf}"
        nominal = getattr(params, leaf, None) if leaf in params._fields else None
        if nominal is None or isinstance(nominal, tuple):
            on = [name for name, one in params._asdict().items() if one is not None and not isinstance(one, tuple)]
            remedy = f"turn it on in the params, or draw one of {', '.join(on)}"
            raise InvalidArgumentError(name, "is off in the params, or none of their numbers", remedy=remedy)
        for _, chosen, distribution in parts(name, each, robot.joint_names):
            for end in np.clip(distribution.support, -_HUGE, _HUGE):
                leaves = np.array(nominal)
                leaves[:, chosen] = distribution.apply(leaves[:, chosen], end)
                params._replace(**{leaf: leaves}).check(params.num_envs, robot.joint_names)


def prepared_actuators(
    randomization: Randomization, actuators: bp.Actuators | None, robot: Robot, control: object = "pid"
) -> bp.Actuators | None:
    """Return ``actuators`` with every field that is drawn on, also where it is neutral, and histories long enough.

    So the state has the same arrays in all envs. Raises InvalidArgumentError if a field is unknown, or has no effect
    under ``control``, or a draw may be out of its range, or changes a limit that is off.
    """
    if not randomization.actuators:
        return actuators
    if control == "drive" and (bypassed := sorted(randomization.actuators.keys() - set(DRIVEN))):
        remedy = f"use control 'pid', or draw only {', '.join(DRIVEN)}"
        raise InvalidArgumentError(f"actuators.{bypassed[0]}", "has no effect on PhysX's drives", remedy=remedy)
    known = bp.Actuators() if actuators is None else actuators
    delay = 0.0 if known.max_delay is None else float(known.max_delay[0, 0])
    values: dict[str, Rows] = {}
    for leaf, each in randomization.actuators.items():
        field = (FIELDS | TABLE)[choice("actuators", leaf, [*FIELDS, *TABLE])]
        nominal = getattr(known, leaf)
        if nominal is None and np.isinf(field.neutral):
            remedy = f"give the runner actuators with {'position_limit' if leaf in TABLE else leaf}"
            raise InvalidArgumentError(f"actuators.{leaf}", "is off, and has no value to change", remedy=remedy)
        values[leaf] = np.full((1, robot.dof), field.neutral) if nominal is None else np.asarray(nominal)
        for _, chosen, distribution in parts(f"actuators.{leaf}", each, robot.joint_names):
            for end in np.clip(distribution.support, -_HUGE, _HUGE):
                rows = np.array(values[leaf])
                rows[:, chosen] = distribution.apply(rows[:, chosen], end)
                each_joint = rows.reshape(len(rows), robot.dof, -1).min(2)
                field.checked(leaf, each_joint, robot.joint_names, infinite=leaf in TABLE)
                delay = max(delay, float(rows.max())) if leaf.endswith("delay") else delay
    like = bp.make_actuators(robot.dof, command_delay=1e-3, position_noise=1.0, max_delay=max(delay, 1e-3))
    noisy = known.seed is None and not values.keys().isdisjoint(("position_noise", "velocity_noise"))
    delayed = not values.keys().isdisjoint(("command_delay", "sensor_delay"))
    return known._replace(
        **values,
        seed=like.seed if noisy else known.seed,
        max_delay=like.max_delay if delayed else known.max_delay,
        continuous=bp.make_actuators(robot.dof, continuous=robot.continuous).continuous,
    )


def _check_range(name: str, each: Field, robot: Robot, mjcf: MjcfFile | None) -> None:
    """Check the results of the least and the largest draws."""
    columns, nominal, bounds = elements(name, robot), nominal_values(name, robot, mjcf), PHYSICAL[name]
    strict = bounds.above
    for _, chosen, distribution in parts(name, each, columns):
        if name in ("payload", "center_of_mass") and distribution.operation == "scale":
            raise InvalidArgumentError(name, "is 0, which cannot be scaled", remedy="use operation 'add'")
        if np.isinf(bounds.low):
            continue
        known = nominal[chosen]
        if strict and distribution.operation == "scale":
            known = np.where(np.isnan(known), 1.0, known)  # the engine finds it
        ends = [distribution.apply(known, end) for end in np.clip(distribution.support, -_HUGE, _HUGE)]
        least = np.min(ends, axis=0)
        good = least > 0 if strict else least >= 0  # NaN is neither
        if not good.all():
            at = int(np.argmin(good))
            raise InvalidArgumentError(
                name,
                f"of {columns[chosen[at]]!r} may become {least[at]:.3g}, but must be {'>' if strict else '>='} 0",
                value=distribution.to_dict(),
                remedy="change the bounds or the operation; a normal distribution takes low=",
            )
