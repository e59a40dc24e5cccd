"""State of the law between steps, and the terms of one step."""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.records import Record, array_summary


class _PIDStateFields(NamedTuple):
    integral: Array = None
    """I, in effort units."""
    measurement: Array = None
    """y of the last step [rad or m]."""
    derivative: Array = None
    """d, the filtered rate of c r - y [rad/s or m/s]."""
    setpoint: Array = None
    """r of the last step [rad or m]."""
    setpoint_seen: Array = None
    """1.0 once ``setpoint`` holds a value to take a difference from, else 0.0."""
    effort: Array = None
    """Effort of the last step [N m or N]."""
    origin: Array = None
    """o: where setpoint weighting measures positions from [rad or m]."""


class PIDState(Record, _PIDStateFields):
    """State of the law, arrays (envs, joints); None where no option needs it."""

    __slots__ = ()
    NAME = "state"


class Terms(NamedTuple):
    """Terms of the law in one step, each (envs, joints); 0 for a term that is off.

    :func:`batchpid.advance` leaves out what :meth:`filled` computes: 0.0 is a term that is off, and
    None a mask.
    """

    p: Array
    """Proportional term [N m or N]."""
    i: Array
    """Integral term as it entered the effort."""
    d: Array
    """Derivative term."""
    feedforward: Array
    """Feedforward as given."""
    unsaturated: Array
    """Their sum: the computed effort."""
    effort: Array
    """The applied effort, after saturation."""
    saturated: Array = None
    """Bool: a limit (of the effort or its rate) changed the effort."""
    finite: Array = None
    """Bool: every input of this env and joint was finite."""

    def filled(self) -> Terms:
        """Return all terms as new arrays (envs, joints), but for the effort."""
        xp = namespace(*self)
        finite = self.finite
        zero = xp.zeros_like(self.effort)
        if finite is None:
            terms = [zero + term for term in self[:5]]
            finite = xp.isfinite(self.unsaturated)
        else:
            terms = [xp.where(finite, term, zero) for term in self[:5]]
        saturated = self.effort != self.unsaturated
        return Terms._make((*terms, self.effort, saturated, finite))

    def __repr__(self) -> str:
        return array_summary(self, "envs", "joints")
