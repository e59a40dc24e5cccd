"""Checks of a randomization: its names, and the range of what can result from its draws."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Rows
from batchpid.checks import choice
from batchpid.errors import InvalidArgumentError
from batchpid.motors import DRIVEN
from batchpid.motors.actuators import ACTUATOR_FIELDS, DELAYS, NOISES
from batchpid.sim.description.tables import MjcfFile
from batchpid.sim.randomization.distributions import Field, elements, nominal_values, parts
from batchpid.sim.randomization.randomization import EVENTS, RANDOMIZED_FIELDS, Randomization
from batchpid.sim.robot.robot import Robot

_ZERO = ("payload", "center_of_mass", "latency", *EVENTS)
"""Fields whose nominal value is 0, which no draw can scale."""


def check_robot(randomization: Randomization, robot: Robot, mjcf: MjcfFile | None = None) -> None:
    """Check that the names and ranges of ``randomization`` fit ``robot``. Raises
    InvalidArgumentError if not.

    ``mjcf`` as for :func:`batchpid.sim.randomization.distributions.nominal_values`.
    """
    _check_events(randomization, robot)
    # check_params and prepared_actuators check the groups.
    for name, field in randomization.distributions.items():
        if name not in RANDOMIZED_FIELDS:
            continue
        columns = elements(name, robot)
        for _, _, part in parts(name, field, columns):
            if name in _ZERO and part.operation == "scale":
                problem = "is 0, which cannot be scaled"
                raise InvalidArgumentError(name, problem, remedy="use operation 'add'")
        for rows in _outermost(name, field, columns, nominal_values(name, robot, mjcf)[None]):
            RANDOMIZED_FIELDS[name].checked(name, rows[0], columns, kind="entry")
    if randomization.damping is not None and robot.source.dissipation != "urdf":
        problem = "cannot be drawn: the engine sets it with this dissipation"
        remedy = "load with dissipation='urdf'"
        raise InvalidArgumentError("damping", problem, remedy=remedy)
    if randomization.payload_link is not None:
        choice("payload_link", randomization.payload_link, list(robot.bodies))


def _check_events(randomization: Randomization, robot: Robot) -> None:
    missing = [name for name in EVENTS if getattr(randomization, name) is None]
    if len(missing) == len(EVENTS):
        return
    for name in missing:
        remedy = "give push and push_interval, or neither"
        raise InvalidArgumentError(name, "is missing", remedy=remedy)
    if robot.fixed_base:
        problem = f"needs a floating base, which {robot.name!r} does not have"
        remedy = "load it with fixed_base=False"
        raise InvalidArgumentError("push", problem, remedy=remedy)


def _outermost(
    name: str,
    field: Field,
    columns: Sequence[str],
    nominal: Rows,
) -> Iterator[Rows]:
    """Yield ``nominal`` (rows, elements, ...) with the least, and with the largest draws of a
    field: all operations are monotonic.
    """
    for end in (0, 1):
        rows = np.array(nominal)
        for _, chosen, distribution in parts(name, field, columns):
            rows[:, chosen] = distribution.apply(rows[:, chosen], distribution.support[end])
        yield rows


def check_params(randomization: Randomization, params: bp.PIDParams, robot: Robot) -> None:
    """Check that the params have the leaves that are drawn, and that no draw makes them invalid.

    Raises InvalidArgumentError if a leaf is off, or a draw may be out of its range.
    """
    leaves = params.leaves()
    for name, field in randomization.params.items():
        if name not in leaves:
            problem = "is off in the params, or not a number"
            remedy = f"draw one of {', '.join(leaves)}"
            raise InvalidArgumentError(f"params.{name}", problem, remedy=remedy)
        for rows in _outermost(f"params.{name}", field, robot.joint_names, leaves[name]):
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
    drawn = randomization.actuators
    if not drawn:
        return actuators
    nominal = actuators or bp.Actuators()
    delay = 1e-3
    if nominal.max_delay is not None:
        delay = float(nominal.max_delay[0, 0])
    for name, field in drawn.items():
        argument = f"actuators.{name}"
        declared = ACTUATOR_FIELDS[choice("actuators", name, ACTUATOR_FIELDS)]
        if control == "drive" and name not in DRIVEN:
            problem = "has no effect on PhysX's drives"
            remedy = f"use control 'pid', or draw only {', '.join(DRIVEN)}"
            raise InvalidArgumentError(argument, problem, remedy=remedy)
        leaf = getattr(nominal, name)
        if leaf is None and np.isinf(declared.neutral):
            problem = "is off, and has no value to change"
            remedy = f"give the runner actuators with {name}"
            raise InvalidArgumentError(argument, problem, remedy=remedy)
        if leaf is None:
            leaf = np.full((1, robot.dof), declared.neutral)
        for rows in _outermost(argument, field, robot.joint_names, leaf):
            declared.checked(name, rows, robot.joint_names)
            if name in DELAYS:
                delay = max(delay, float(rows.max()))
        values: Document = {name: leaf}
        nominal = nominal._replace(**values)
    # Histories and noise are on where any draw needs them.
    like = bp.make_actuators(
        robot.dof,
        command_delay=delay,
        position_noise=1.0,
        continuous=robot.continuous,
    )
    nominal = nominal._replace(continuous=like.continuous)
    if not drawn.keys().isdisjoint(DELAYS):
        nominal = nominal._replace(max_delay=like.max_delay)
    if nominal.seed is None and not drawn.keys().isdisjoint(NOISES):
        nominal = nominal._replace(seed=like.seed)
    return nominal
