"""Checks of a randomization: its names, and the range of what can result from its draws."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Rows
from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError
from batchpid.motors import DRIVEN
from batchpid.motors.actuators import DELAYS, NOISES
from batchpid.motors.actuators import FIELDS as OF_ACTUATORS
from batchpid.sim.randomization.distributions import GROUPS, Field, elements, nominal_values, parts
from batchpid.sim.randomization.randomization import EVENTS, FIELDS, Randomization
from batchpid.sim.robot.parts import MjcfFile
from batchpid.sim.robot.robot import Robot

_HUGE = 1e300
_ZERO = ("payload", "center_of_mass", *EVENTS)
"""Fields whose nominal value is 0, which no draw can scale."""


def check_robot(randomization: Randomization, robot: Robot, mjcf: MjcfFile | None = None) -> None:
    """Check that the names and ranges of ``randomization`` fit ``robot``. Raises
    InvalidArgumentError if not.

    ``mjcf`` as for :func:`batchpid.sim.randomization.distributions.nominal_values`.
    """
    _check_events(randomization, robot)
    for name, field in (randomization.given | randomization.events).items():
        if name.partition(".")[0] in GROUPS:
            continue  # check_params and prepared_actuators
        columns = elements(name, robot)
        scales = [part.operation == "scale" for *_, part in parts(name, field, columns)]
        if name in _ZERO and any(scales):
            problem = "is 0, which cannot be scaled"
            raise InvalidArgumentError(name, problem, remedy="use operation 'add'")
        for rows in _extremes(name, field, columns, nominal_values(name, robot, mjcf)[None]):
            FIELDS[name].checked(name, rows[0], columns, kind="entry")
    if randomization.damping is not None and robot.dissipation != "urdf":
        problem = "cannot be drawn: the engine sets it with this dissipation"
        remedy = "load with dissipation='urdf'"
        raise InvalidArgumentError("damping", problem, remedy=remedy)
    if randomization.payload_link is not None:
        choice("payload_link", randomization.payload_link, [link.name for link in robot.links])


def _check_events(randomization: Randomization, robot: Robot) -> None:
    events = randomization.events
    if not events:
        return
    for name in EVENTS:
        if name not in events:
            problem = f"is missing, and there is a {next(iter(events))}"
            raise InvalidArgumentError(name, problem, remedy="give both, or none")
    if robot.fixed_base:
        problem = f"needs a floating base, which {robot.name!r} does not have"
        remedy = "load it with fixed_base=False"
        raise InvalidArgumentError("push", problem, remedy=remedy)


def _extremes(name: str, field: Field, columns: Sequence[str], nominal: Rows) -> Iterator[Rows]:
    """Yield ``nominal`` (rows, elements, ...) with the least and with the largest draw of each part
    of a field.
    """
    for _, chosen, distribution in parts(name, field, columns):
        for end in np.clip(distribution.support, -_HUGE, _HUGE):
            rows = np.array(nominal)
            rows[:, chosen] = distribution.apply(rows[:, chosen], end)
            yield rows


def check_params(randomization: Randomization, params: bp.PIDParams, robot: Robot) -> None:
    """Check that the params have the leaves that are drawn, and that no draw makes them invalid.

    Raises InvalidArgumentError if a leaf is off, or a draw may be out of its range.
    """
    # A draw at an end of its range is the worst, since all operations are monotonic.
    leaves = params.leaves()
    for name, distribution in randomization.params.items():
        if name not in leaves:
            problem = "is off in the params, or none of their numbers"
            remedy = f"draw one of {', '.join(leaves)}"
            raise InvalidArgumentError(f"params.{name}", problem, remedy=remedy)
        for rows in _extremes(f"params.{name}", distribution, robot.joint_names, leaves[name]):
            drawn: Document = {name: rows}
            params._replace(**drawn).check(params.num_envs, robot.joint_names)


def prepared_actuators(
    randomization: Randomization,
    actuators: bp.Actuators | None,
    robot: Robot,
    control: object = "pid",
) -> bp.Actuators | None:
    """Return ``actuators`` with every field that is drawn on, also where it is neutral, and
    histories long enough.

    So the state has the same arrays in all envs. Raises InvalidArgumentError if a field is unknown,
    or has no effect under ``control``, or a draw may be out of its range, or changes a limit that
    is off.
    """
    if not randomization.actuators:
        return actuators
    bypassed = sorted(randomization.actuators.keys() - set(DRIVEN))
    if control == "drive" and bypassed:
        problem = "has no effect on PhysX's drives"
        remedy = f"use control 'pid', or draw only {', '.join(DRIVEN)}"
        raise InvalidArgumentError(f"actuators.{bypassed[0]}", problem, remedy=remedy)
    if actuators is None:
        nominal = bp.Actuators()
    else:
        nominal = actuators
    if nominal.max_delay is None:
        delay = 0.0
    else:
        delay = float(nominal.max_delay[0, 0])
    values: Document = {}
    for name, field in randomization.actuators.items():
        values[name], most = _with_extremes(name, field, nominal, robot)
        if name in DELAYS:
            delay = max(delay, most)
    # Histories and noise are on where any draw needs them.
    like = bp.make_actuators(
        robot.dof, command_delay=1e-3, position_noise=1.0, max_delay=max(delay, 1e-3)
    )
    if not values.keys().isdisjoint(DELAYS):
        values["max_delay"] = like.max_delay
    if nominal.seed is None and not values.keys().isdisjoint(NOISES):
        values["seed"] = like.seed
    values["continuous"] = bp.make_actuators(robot.dof, continuous=robot.continuous).continuous
    return nominal._replace(**values)


def _with_extremes(
    name: str, field: Field, actuators: bp.Actuators, robot: Robot
) -> tuple[Rows, float]:
    """Return the nominal values of a field of the actuators, and the largest that can be drawn."""
    declared = OF_ACTUATORS[choice("actuators", name, OF_ACTUATORS)]
    leaf = getattr(actuators, name)
    if leaf is None and np.isinf(declared.neutral):
        remedy = f"give the runner actuators with {name}"
        problem = "is off, and has no value to change"
        raise InvalidArgumentError(f"actuators.{name}", problem, remedy=remedy)
    if leaf is None:
        nominal = np.full((1, robot.dof), declared.neutral)
    else:
        nominal = np.asarray(leaf)
    most = -np.inf
    for rows in _extremes(f"actuators.{name}", field, robot.joint_names, nominal):
        declared.checked(name, rows, robot.joint_names)
        most = max(most, float(rows.max()))
    return nominal, most
