"""Checks of a randomization: its names, and the range of what can result from its draws."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

import batchpid as bp
from batchpid.arrays.array_types import Document, Rows
from batchpid.checks.validate import choice
from batchpid.errors import InvalidArgumentError
from batchpid.motors import DRIVEN
from batchpid.motors.actuators import FIELDS as OF_ACTUATORS
from batchpid.motors.actuators import TABLE
from batchpid.sim.randomization.fields import GROUPS, Field, elements, nominal_values, parts
from batchpid.sim.randomization.randomization import EVENTS, FIELDS, Randomization
from batchpid.sim.robot.parts import MjcfFile
from batchpid.sim.robot.robot import Robot

_HUGE = 1e300
_ZERO = ("payload", "center_of_mass", *EVENTS)
"""Fields whose nominal value is 0, which no draw can scale."""


def check_robot(randomization: Randomization, robot: Robot, mjcf: MjcfFile | None = None) -> None:
    """Check that the names and ranges of ``randomization`` fit ``robot``. Raises
    InvalidArgumentError if not.

    ``mjcf`` as for :func:`batchpid.sim.randomization.fields.nominal_values`.
    """
    events = randomization.events
    for name in EVENTS if events else ():
        if name not in events:
            other = next(iter(events))
            raise InvalidArgumentError(
                name, f"is missing, and there is a {other}", remedy="give both, or none"
            )
    if events and robot.fixed_base:
        remedy = "load it with fixed_base=False"
        raise InvalidArgumentError(
            "push", f"needs a floating base, which {robot.name!r} does not have", remedy=remedy
        )
    for name, distribution in (randomization.given | events).items():
        if name.partition(".")[0] in GROUPS:
            continue  # check_params and prepared_actuators
        columns = elements(name, robot)
        if name in _ZERO and any(
            part.operation == "scale" for *_, part in parts(name, distribution, columns)
        ):
            raise InvalidArgumentError(
                name, "is 0, which cannot be scaled", remedy="use operation 'add'"
            )
        for rows in _extremes(name, distribution, columns, nominal_values(name, robot, mjcf)[None]):
            FIELDS[name].checked(name, rows[0], columns, kind="entry")
    if randomization.damping is not None and robot.dissipation != "urdf":
        problem, remedy = (
            "cannot be drawn: the engine sets it with this dissipation",
            "load with dissipation='urdf'",
        )
        raise InvalidArgumentError("damping", problem, remedy=remedy)
    if randomization.payload_link is not None:
        choice("payload_link", randomization.payload_link, [link.name for link in robot.links])


def _extremes(name: str, each: Field, columns: Sequence[str], nominal: Rows) -> Iterator[Rows]:
    """Yield ``nominal`` (rows, elements, ...) with the least and with the largest draw of each part
    of a field.
    """
    for _, chosen, distribution in parts(name, each, columns):
        for end in np.clip(distribution.support, -_HUGE, _HUGE):
            rows = np.array(nominal)
            rows[:, chosen] = distribution.apply(rows[:, chosen], end)
            yield rows


def check_params(randomization: Randomization, params: bp.PIDParams, robot: Robot) -> None:
    """Check that the params have the leaves that are drawn, and that no draw makes them invalid.

    Raises InvalidArgumentError if a leaf is off, or a draw may be out of its range.
    """
    leaves = {
        name: leaf
        for name, leaf in params._asdict().items()
        if leaf is not None and not isinstance(leaf, tuple)
    }
    for name, distribution in randomization.params.items():
        if name not in leaves:
            problem, remedy = (
                "is off in the params, or none of their numbers",
                f"draw one of {', '.join(leaves)}",
            )
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
    if control == "drive" and (bypassed := sorted(randomization.actuators.keys() - set(DRIVEN))):
        remedy = f"use control 'pid', or draw only {', '.join(DRIVEN)}"
        raise InvalidArgumentError(
            f"actuators.{bypassed[0]}", "has no effect on PhysX's drives", remedy=remedy
        )
    known = bp.Actuators() if actuators is None else actuators
    delay = 0.0 if known.max_delay is None else float(known.max_delay[0, 0])
    values: dict[str, Rows] = {}
    for leaf, each in randomization.actuators.items():
        field = (OF_ACTUATORS | TABLE)[choice("actuators", leaf, [*OF_ACTUATORS, *TABLE])]
        nominal = getattr(known, leaf)
        if nominal is None and np.isinf(field.neutral):
            remedy = f"give the runner actuators with {'position_limit' if leaf in TABLE else leaf}"
            raise InvalidArgumentError(
                f"actuators.{leaf}", "is off, and has no value to change", remedy=remedy
            )
        values[leaf] = (
            np.full((1, robot.dof), field.neutral) if nominal is None else np.asarray(nominal)
        )
        for rows in _extremes(f"actuators.{leaf}", each, robot.joint_names, values[leaf]):
            least = rows.reshape(len(rows), robot.dof, -1).min(2)
            field.checked(leaf, least, robot.joint_names, infinite=leaf in TABLE)
            delay = max(delay, float(rows.max())) if leaf.endswith("delay") else delay
    like = bp.make_actuators(
        robot.dof, command_delay=1e-3, position_noise=1.0, max_delay=max(delay, 1e-3)
    )
    noisy = known.seed is None and not values.keys().isdisjoint(
        ("position_noise", "velocity_noise")
    )
    delayed = not values.keys().isdisjoint(("command_delay", "sensor_delay"))
    return known._replace(
        **values,
        seed=like.seed if noisy else known.seed,
        max_delay=like.max_delay if delayed else known.max_delay,
        continuous=bp.make_actuators(robot.dof, continuous=robot.continuous).continuous,
    )
