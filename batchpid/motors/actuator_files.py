"""Actuators to and from YAML or JSON that people read and edit: one entry per joint, by name.

A file has this form::

    format: batchpid-actuators-1
    about: {robot: arm, log: chirp.csv}
    joints:
      shoulder: {command_delay: 0.0037, strength: 0.92, coulomb: 0.4, viscous: 1.1, armature: 0.02}
      elbow: {strength: 0.95, position_limit: [[-1.0, 0.0, 1.0], [20.0, 30.0, 25.0]]}
      wrist: {}

The keys are the options of :func:`batchpid.make_actuators`; see
:class:`batchpid.io.documents.RecordFile`. A joint that is left out has ideal actuators.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from batchpid.arrays.array_types import Document
from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.io.documents import RecordFile, error, is_number
from batchpid.motors.actuators import FIELDS, Actuators, make_actuators

_TABLE = "position_limit"


class _ActuatorFile(RecordFile[Actuators]):
    """A limit by position is two lists, positions and efforts."""

    def entries(self, options: Document, joint_names: Sequence[str]) -> dict[str, Document]:
        """Return the entries; a limit that differs from env to env is an error."""
        table = options.pop(_TABLE, None)
        entries = super().entries(options, joint_names)
        if table is None:
            return entries
        positions, efforts = table
        if max(len(positions), len(efforts)) > 1:
            problem = "have a position_limit for each env, and a file has one"
            remedy = "save those of one env: actuators.for_envs(slice(k, k + 1))"
            raise InvalidArgumentError("actuators", problem, remedy=remedy)
        for at, entry in enumerate(entries.values()):
            if np.isfinite(efforts[0, at]).all():
                entry[_TABLE] = [positions[0, at].tolist(), efforts[0, at].tolist()]
        return entries

    def arguments(self, source: str, joints: Mapping[str, Document]) -> Document:
        """Return the options, with tables of as many points for all joints: the last one is
        repeated, and infinite efforts are no limit.
        """
        options = super().arguments(source, joints)
        tables = {joint: entry[_TABLE] for joint, entry in joints.items() if _TABLE in entry}
        if not tables:
            return options
        points = max(2, *(len(positions) for positions, _ in tables.values()))
        none = [list(range(points)), [np.inf] * points]
        padded = [
            [row + row[-1:] * (points - len(row)) for row in tables.get(joint, none)]
            for joint in joints
        ]
        return options | {_TABLE: np.array(padded, float).swapaxes(0, 1)}

    def check_option(self, source: str, joint: str, name: str, value: object) -> None:
        """Raise InvalidArgumentError for an unknown option, or a value of a wrong type."""
        if name != _TABLE:
            super().check_option(source, joint, name, value)
            return
        rows = [row for row in value if isinstance(row, list)] if isinstance(value, list) else []
        numbers = [entry for row in rows for entry in row]
        if len(rows) != 2 or len(rows[0]) != len(rows[1]) or not all(map(is_number, numbers)):
            remedy = f"give '{_TABLE}: [[positions], [efforts]]'"
            raise error(source, name, "must be two lists of as many numbers", remedy, joint)


ACTUATORS = _ActuatorFile(
    "batchpid-actuators-1",
    Actuators,
    make_actuators,
    ("seed", "max_delay"),
    {**FIELDS, "continuous": Field(neutral=False)},
    partial=True,
)
dumps_actuators = ACTUATORS.dumps
loads_actuators = ACTUATORS.loads
save_actuators = ACTUATORS.save
load_actuators = ACTUATORS.load
