"""Actuators to and from YAML or JSON that people read and edit: one entry per joint, by name.

A file has this form::

    format: batchpid-actuators-1
    about: {robot: arm, log: chirp.csv}
    joints:
      shoulder: {command_delay: 0.0037, strength: 0.92, coulomb: 0.4, viscous: 1.1, armature: 0.02}
      elbow: {strength: 0.95, position_limit: [[-1.0, 0.0, 1.0], [20.0, 30.0, 25.0]]}
      wrist: {}

The keys are the options of :func:`batchpid.make_actuators`; a list gives one value per env. An
option left out of a joint is off there, and a joint that is left out has ideal actuators.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Document
from batchpid.arrays.field_tables import Field
from batchpid.checks.validate import instance, names
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.motors.actuators import FIELDS, Actuators, make_actuators

_FIELDS = {**FIELDS, "continuous": Field(neutral=False)}
_SCHEMA = documents.Schema(
    "batchpid-actuators-1", "actuators", ("dtype", "seed", "max_delay"), _FIELDS
)
_TABLE = "position_limit"


def dumps_actuators(
    actuators: Actuators,
    joint_names: Sequence[str],
    about: Mapping[str, Any] | None = None,
    format: str = "yaml",
) -> str:
    """Return ``actuators`` as text in ``format``, "yaml" or "json", with one name per joint.

    ``about`` is kept with them, e.g. where they come from: plain numbers, strings, lists, mappings.
    Raises InvalidArgumentError for actuators of another type, names that do not fit, an unknown
    format, or a limit by position that differs from env to env.
    """
    instance("actuators", actuators, Actuators, "build them with make_actuators")
    joints, options = names("joint_names", joint_names, actuators.num_joints), actuators.options()
    table = options.pop(_TABLE, None)
    document = documents.document(_SCHEMA, options, joints, about)
    if table is not None and max(map(len, table)) > 1:
        remedy = "save those of one env: actuators.for_envs(slice(k, k + 1))"
        raise InvalidArgumentError(
            "actuators", "have a position_limit for each env, and a file has one", remedy=remedy
        )
    for index, joint in enumerate(joints if table is not None else ()):
        if np.isfinite(table[1][0, index]).all():
            document["joints"][joint][_TABLE] = [rows[0, index].tolist() for rows in table]
    return documents.render(document, format)


def save_actuators(
    path: str | os.PathLike[str],
    actuators: Actuators,
    joint_names: Sequence[str],
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write ``actuators`` to ``path`` (.yaml, .yml or .json), as :func:`dumps_actuators`.

    An existing file is replaced as a whole or not at all.
    """
    documents.write(path, lambda format: dumps_actuators(actuators, joint_names, about, format))


def load_actuators(
    path: str | os.PathLike[str], joint_names: Sequence[str] | None = None
) -> tuple[Actuators, list[str]]:
    """Return the actuators in a file and their joints' names, in the order of ``joint_names`` if
    given.

    Of ``joint_names`` the file may leave some out. Nothing in the file is executed, and every value
    is checked as in :func:`batchpid.make_actuators`.

    Raises
    ------
    InvalidArgumentError
        Naming the file, joint and key.
    FileNotFoundError
        The file does not exist.
    """
    return _build(str(path), documents.read(path), joint_names)


def loads_actuators(
    text: str, joint_names: Sequence[str] | None = None
) -> tuple[Actuators, list[str]]:
    """Return the actuators in a text, JSON if it begins with a brace and else YAML; otherwise as
    the file's.
    """
    return _build("text", documents.parse_text(text), joint_names)


def _build(
    source: str, document: Any, joint_names: Sequence[str] | None
) -> tuple[Actuators, list[str]]:
    """Return the actuators of a document and the names of their joints."""
    tables = _take_tables(source, document)
    joints = documents.check(source, document, _SCHEMA)
    order = list(joints) if joint_names is None else names("joint_names", joint_names)
    if unknown := sorted(set(joints) - set(order)):
        problem, remedy = (
            f"holds unknown joints {unknown}",
            f"the robot's joints are {', '.join(order)}",
        )
        raise InvalidArgumentError(source, problem, remedy=remedy)
    position_limit = {_TABLE: _joined(tables, order)} if tables else {}
    ordered = {joint: joints.get(joint, {}) for joint in order}
    return (
        documents.build(source, document, _SCHEMA, ordered, make_actuators, **position_limit),
        order,
    )


def _take_tables(source: str, document: Any) -> Document:
    """Return the limits by position of a document by joint, removed from it."""
    joints = document.get("joints") if isinstance(document, dict) else None
    tables = {}
    for joint, options in (joints if isinstance(joints, dict) else {}).items():
        if isinstance(options, dict) and _TABLE in options:
            rows = tables[joint] = options.pop(_TABLE)
            shaped = (
                isinstance(rows, list)
                and len(rows) == 2
                and all(isinstance(row, list) for row in rows)
            )
            if not shaped or len({len(row) for row in rows}) > 1 or not _are_numbers(rows):
                remedy = f"give '{_TABLE}: [[positions], [efforts]]'"
                raise documents.error(
                    source, _TABLE, "must be two lists of as many numbers", remedy, joint
                )
    return tables


def _are_numbers(rows: list[list[Any]]) -> bool:
    return all(documents.is_number(entry) for row in rows for entry in row)


def _joined(tables: Mapping[str, Any], order: Sequence[str]) -> tuple[Array, Array]:
    """Return positions and efforts (joints, points), with the last point repeated; infinite efforts
    for no limit.
    """
    count = max(2, *(len(rows[0]) for rows in tables.values()))
    none = [list(range(count)), [np.inf] * count]
    padded = [
        [row + row[-1:] * (count - len(row)) for row in tables.get(joint, none)] for joint in order
    ]
    positions, efforts = zip(*padded, strict=True)
    return np.array(positions, float), np.array(efforts, float)
