"""Actuators to and from YAML or JSON that people read and edit: one entry per joint, by name.

A file has this form::

    format: batchpid-actuators-1
    about: {robot: arm, log: chirp.csv}
    joints:
      shoulder: {command_delay: 0.0037, strength: 0.92, coulomb: 0.4, viscous: 1.1, armature: 0.02}
      elbow: {strength: 0.95}
      wrist: {}

The keys are the options of :func:`batchpid.make_actuators`; see
:class:`batchpid.io.documents.RecordFile`. A joint that is left out has ideal actuators.
"""

from __future__ import annotations

from batchpid.arrays.field_tables import Field
from batchpid.io.documents import RecordFile
from batchpid.motors.actuators import FIELDS, Actuators, make_actuators

ACTUATORS = RecordFile(
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
