"""Log of the contacts that robots without collision shapes would have had."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from batchpid.arrays.array_types import Rows
from batchpid.sim.loop.arrays import Arrays


class MissedContactWarning(UserWarning):
    """Robots that are simulated without collisions would have touched something."""


class MissedContact(NamedTuple):
    """First contact that an env's robot would have had since its reset."""

    env: int
    time: float
    """End of the tick in which it was found [s]."""
    links: tuple[str, ...]
    """Names of the two links; of one if it is with the ground."""

    def __str__(self) -> str:
        what = " and ".join(map(repr, self.links)) + (
            " and the ground" if len(self.links) == 1 else ""
        )
        return f"env {self.env}: {what} at {self.time:g} s"


class MissedContactLog:
    """Last 10 000 missed contacts of a runner's envs. Immutable; methods return a modified copy.

    ``links`` returns the names of the links that overlap most at a pose (dof,).
    """

    def __init__(
        self, num_envs: int, timestep: float, links: Callable[[Rows], tuple[str, ...]]
    ) -> None:
        self.contacts: deque[MissedContact] = deque(maxlen=10_000)
        """Latest last."""
        self._timestep, self._links = timestep, links
        self._steps = np.zeros(num_envs, np.int64)

    def with_contacts(self, arrays: Arrays) -> MissedContactLog:
        """Return a log with the contacts of ``arrays`` that are not in this one."""
        steps = arrays.fault.missed_contact
        new = np.flatnonzero((steps != 0) & (steps != self._steps)).tolist()
        if not new:
            return self
        log = copy.copy(self)
        log._steps, log.contacts = steps.copy(), self.contacts.copy()
        for env in new:
            links = self._links(arrays.observation.qpos[env])
            log.contacts.append(MissedContact(env, int(steps[env]) * self._timestep, links))
        return log

    def message(self) -> str:
        """Return the text of a warning."""
        return (
            "without collisions robots went through what they would have touched:"
            f" {self.contacts[0]}. Use collisions=True, or other moves; see runner.missed_contacts"
            " for more, of which there is no further warning"
        )
