"""Parameters of plans: build, validate, save.

A file in YAML has the options of the whole plan, and one entry per joint
(:class:`batchpid.io.documents.RecordFile`)::

    format: batchpid-plan-1
    period: 0.03333333333333333
    horizon: 16
    blend: align
    interpolation: cubic
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
INTERPOLATIONS = {"cubic": 3.0, "linear": 1.0, "hold": 0.0}
"""Interpolations, with the degree of the curve between two rows."""
BLENDS = {
    "align": "fade",
    "newest": "",
    "ensemble": "weight",
}
"""Blends, with the option that each of them has."""


class _PlanFields(NamedTuple):
    period: Array
    """P [s]."""
    rows: Array
    """Number of the last knot of the tables, horizon + 1."""
    degree: Array
    """Degree of the curve between two rows."""
    blended: Array
    """1.0 on the joints whose chunks are blended, 0.0 on those that take the newest value."""
    fade: Annotated[Array, Field("s", above=True, default=1.0)] = None
    weight: Annotated[
        Array,
        Field(
            "1",
            low=-9.0,
            high=9.0,
            default=0.01,
        ),
    ] = None
    forgotten: Array = None
    """1 - exp(-m) of an ensemble."""
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
        blends = [blend for blend, option in BLENDS.items() if option in leaves]
        degrees = {degree: name for name, degree in INTERPOLATIONS.items()}
        return {
            "period": float(self.period[0, 0]),
            "horizon": self.horizon,
            "blend": blends[0] if blends else "newest",
            "interpolation": degrees[float(self.degree[0, 0])],
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
    interpolation: str = "cubic",
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
        - "ensemble": the mean of all chunks for the same time, with weights exp(-m i), where i is 0
          for the oldest one.
    fade
        Of "align": time over which the offset fades [s]; default 1.
    weight
        Of "ensemble": m; default 0.01.
    interpolation
        "cubic", with rates that are central differences of the blended rows; "linear", or "hold".
    latest
        Indices of the joints that take the newest value without a blend, such as a gripper.
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
        Naming the option, joint, env and value; also for an option of another blend.
    """
    options = {name: value for name, value in options.items() if value is not None}
    build = LeafBuilder(joints, joint_names, dtype, options.values())
    leaves = build.options(PLAN_FIELDS, options)
    # A blend has its own option alone.
    option = BLENDS[choice("blend", blend, BLENDS)]
    for name in sorted(options.keys() & set(BLENDS.values()) - {option}):
        remedy = "leave it out, or choose another blend"
        raise InvalidArgumentError(name, f"has no effect with blend {blend!r}", remedy=remedy)
    if option:
        field = PLAN_FIELDS[option]
        # An ensemble stays one where m is 0.
        leaves[option] = build.array(option, options.get(option, field.default), field)
    if option == "weight":
        leaves["forgotten"] = 1.0 - np.exp(-leaves["weight"])
    horizon = integer("horizon", horizon, 1, LONGEST_HORIZON)
    newest = [integer("latest", joint, 0, build.joints - 1) for joint in latest]
    degree = INTERPOLATIONS[choice("interpolation", interpolation, INTERPOLATIONS)]
    leaves |= {
        "period": build.rows("period", np.array(positive("period", period, "s"))),
        "rows": build.rows("horizon", np.array(horizon + SPARE_ROWS - 1.0)),
        "degree": build.rows("interpolation", np.array(degree)),
        "blended": 1.0 - np.isin(np.arange(build.joints), newest)[None],
    }
    return Plan(**{name: build.freeze(leaf) for name, leaf in leaves.items()})


PLANS = RecordFile(
    "batchpid-plan-1",
    Plan,
    make_plan,
    ("period", "horizon", "blend", "interpolation", "latest", "dtype"),
    PLAN_FIELDS,
)
dumps_plan = PLANS.dumps
loads_plan = PLANS.loads
save_plan = PLANS.save
load_plan = PLANS.load
