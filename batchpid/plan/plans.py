"""Parameters of plans: build, validate, save.

A file in YAML or JSON has the options of the whole plan, and one entry per joint
(:class:`batchpid.io.documents.RecordFile`)::

    format: batchpid-plan-1
    period: 0.03333333333333333
    horizon: 16
    blend: align
    latest: [1]
    joints:
      shoulder: {fade: 1.0, rate: 2.0, acceleration: 15.0}
      gripper: {fade: 1.0}
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from batchpid.arrays.array_types import Array, Document, DType
from batchpid.arrays.field_tables import Field, declared
from batchpid.arrays.records import LeafBuilder, Record, with_fields
from batchpid.checks import choice, integer, positive
from batchpid.errors import InvalidArgumentError
from batchpid.io.documents import RecordFile
from batchpid.motors.guard import GUARD_FIELDS

LONGEST_HORIZON = 1000
"""Most rows of a chunk."""
SPARE_ROWS = 2
"""Knots behind the rows of a chunk, at rest."""
BLENDS = ("align", "newest")


class _PlanFields(NamedTuple):
    period: Array
    """P [s]."""
    rows: Array
    """Number of the last knot of the tables, horizon + 1."""
    blended: Array
    """1.0 on the joints whose chunks are aligned, 0.0 on those that take the newest value."""
    fade: Annotated[Array, Field("s", above=True, default=1.0)] = None
    rate: Annotated[Array, GUARD_FIELDS["rate"]] = None
    """V [rad/s or m/s]."""
    acceleration: Annotated[Array, GUARD_FIELDS["acceleration"]] = None
    """A [rad/s^2 or m/s^2]."""


PLAN_FIELDS = declared(_PlanFields, Field)
"""Options of a joint."""


class Plan(Record, _PlanFields):
    """Parameters of a plan, (1, joints) or (envs, joints); None is off. Build one with
    :func:`make_plan`.
    """

    __slots__ = ()
    NAME = "plan"
    FIELDS = PLAN_FIELDS

    @property
    def horizon(self) -> int:
        """Most rows of a chunk."""
        return int(self.rows[0, 0]) + 1 - SPARE_ROWS

    def options(self) -> Document:
        """Return the options that are on, as arguments of :func:`make_plan` that build this plan
        again.
        """
        leaves = self.leaves()
        return {
            "period": float(self.period[0, 0]),
            "horizon": self.horizon,
            "blend": "align" if "fade" in leaves else "newest",
            "latest": np.flatnonzero(self.blended[0] == 0).tolist(),
            "dtype": np.dtype(self.dtype),
            **{name: leaf for name, leaf in leaves.items() if name in PLAN_FIELDS},
        }


@with_fields(*PLAN_FIELDS)
def make_plan(
    joints: int,
    *,
    period: float,
    horizon: int,
    blend: str = "align",
    latest: Sequence[int] = (),
    joint_names: Sequence[str] | None = None,
    dtype: DType = None,
    **options: Array,
) -> Plan:
    """Build a validated :class:`Plan`; a number of a joint may be a scalar, (joints,) or (envs,
    joints).

    Parameters
    ----------
    joints
        Number of joints.
    period
        Time between two rows of a chunk [s].
    horizon
        Most rows of a chunk.
    blend
        What a chunk does to the plan that is being executed:

        - "align": the chunk is moved to it, by an offset that fades to 0. A chunk of one row is
          taken as it is.
        - "newest": the chunk replaces the plan.
    fade
        Of "align": time over which the offset fades [s]; default 1.
    latest
        Indices of the joints that take the newest value without an offset, such as a gripper.
    rate, acceleration
        Limits > 0 of the setpoint's rate and acceleration [rad/s or m/s, and per second], by
        :mod:`batchpid.motors.guard`; default none.
    joint_names
        Used in error messages.
    dtype
        float32 or float64; default float64.

    Raises
    ------
    InvalidArgumentError
        Naming the option, joint, env and value; also for a fade of another blend.
    """
    build = LeafBuilder(joints, joint_names, dtype, options.values())
    fade = options.get("fade")
    if choice("blend", blend, BLENDS) == "align":
        options["fade"] = PLAN_FIELDS["fade"].default if fade is None else fade
    elif fade is not None:
        problem = "has no effect with blend 'newest'"
        raise InvalidArgumentError("fade", problem, remedy="leave it out, or choose 'align'")
    leaves = build.options(PLAN_FIELDS, options)
    horizon = integer("horizon", horizon, 1, LONGEST_HORIZON)
    newest = [integer("latest", joint, 0, build.joints - 1) for joint in latest]
    leaves |= {
        "period": build.rows("period", np.array(positive("period", period, "s"))),
        "rows": build.rows("horizon", np.array(horizon + SPARE_ROWS - 1.0)),
        "blended": 1.0 - np.isin(np.arange(build.joints), newest)[None],
    }
    return Plan(**{name: build.freeze(leaf) for name, leaf in leaves.items()})


PLANS = RecordFile(
    "batchpid-plan-1",
    Plan,
    make_plan,
    ("period", "horizon", "blend", "latest", "dtype"),
    PLAN_FIELDS,
)
dumps_plan = PLANS.dumps
loads_plan = PLANS.loads
save_plan = PLANS.save
load_plan = PLANS.load
