"""State of actuators and sensors between steps."""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Array
from batchpid.arrays.display import array_summary
from batchpid.arrays.records import Record


class _ActuatorStateFields(NamedTuple):
    command: Array = None
    """Efforts asked for, latest first (envs, samples, joints) [N m or N]."""
    effort: Array = None
    """Effort behind the lag (envs, joints) [N m or N]."""
    sensor: Array = None
    """Positions that the sensor was at, and its velocities, latest first (envs, samples, 2
    joints).
    """
    encoder: Array = None
    """Position of the sensor's side of the play (envs, joints) [rad or m]."""
    key: Array = None
    """Key of the noise, a hash of seed, env and episode (envs, 2) uint32."""
    step: Array = None
    """Measurements since the reset (envs,) uint32."""


class ActuatorState(Record, _ActuatorStateFields):
    """State of actuators and sensors; None where no effect needs it. Every array has the envs as
    its first axis.
    """

    __slots__ = ()
    NAME = "state"

    def __repr__(self) -> str:
        return array_summary(self._replace(key=None, step=None), "envs", "joints")

    def matched_to(self, fresh: ActuatorState) -> ActuatorState:
        """Return this state with exactly the leaves of ``fresh``: missing ones from there, the
        others dropped.

        A history that is longer there is continued by its oldest sample. The key is taken from
        ``fresh``.
        """
        matched = super().matched_to(fresh)
        histories = {
            name: _resized(leaf, getattr(fresh, name)) for name, leaf in matched.leaves().items()
        }
        return matched._replace(**histories | {"key": fresh.key})


def _resized(old: Array, new: Array) -> Array:
    """Return a history of the length of another; other arrays as they are."""
    if old.ndim < 3 or old.shape == new.shape:
        return old
    xp = old.__array_namespace__()
    samples = new.shape[1]
    if samples < old.shape[1]:
        return old[:, :samples].copy()
    oldest = xp.broadcast_to(old[:, -1:], (old.shape[0], samples - old.shape[1], old.shape[2]))
    return xp.concatenate((old, oldest), axis=1)
