"""Params to and from YAML or JSON that people read and edit: one entry per joint, by name.

A file has this form::

    format: batchpid-params-1
    dtype: float64
    non_finite: propagate
    joints:
      shoulder: {kp: 40.0, ki: 5.0, kd: 2.0, effort_max: 87.0, anti_windup: conditional}
      elbow: {kp: 20.0, ki: 5.0, kd: 2.0}

The keys are the options of :func:`batchpid.make_params`; see
:class:`batchpid.io.documents.RecordFile`.
"""

from __future__ import annotations

from collections.abc import Mapping

from batchpid.arrays.array_types import Document
from batchpid.arrays.choices import CHOICES
from batchpid.io.documents import RecordFile, error
from batchpid.law.params import FIELDS, PIDParams, make_params


class _ParamsFile(RecordFile[PIDParams]):
    def arguments(self, source: str, joints: Mapping[str, Document]) -> Document:
        """Return the options; a time of back-calculation that only some joints have is an error."""
        options = super().arguments(source, joints)
        for joint, entry in joints.items() if "tracking_time" in options else ():
            tracks = "back_calculation" in str(entry.get("anti_windup"))
            if tracks and "tracking_time" not in entry:
                problem = "is missing, while other joints have it"
                raise error(source, "tracking_time", problem, "give it too", joint)
        return options


PARAMS = _ParamsFile(
    "batchpid-params-1", PIDParams, make_params, tuple(CHOICES), FIELDS, required=("kp",)
)
dumps_params = PARAMS.dumps
loads_params = PARAMS.loads
save_params = PARAMS.save
load_params = PARAMS.load
load_about = PARAMS.load_about
