"""Parts of a group of envs: its pack, and params and actuators with the draws of the randomization;
sensors of links; pushes of bases.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Bool, Float64, Rows
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.engine.scene_spec import SceneSpec, Variation
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import Draws, elements, nominal_values
from batchpid.sim.randomization.randomization import PHYSICAL
from batchpid.sim.signals import untouched

Int64 = NDArray[np.int64]
COUNTS = ("steps", "due", "number")
"""Counters of an env: sim steps since the reset, the sim step of the next push, and the number of
pushes so far.
"""


class ActingDraws:
    """Params and actuators of a group, with the draws of its envs applied.

    Attributes
    ----------
    draws
        Draws of the envs; None before the first reset. A reset, or new params, put them into
        effect.
    params, actuators
        As they were given.
    acting_params
        With the draws in effect.
    acting_actuators
        With the draws in effect.
    """

    def __init__(self, options: RunnerOptions, params: bp.PIDParams) -> None:
        self._options = options
        self.draws: Draws | None = None
        self.params = self.acting_params = params
        self.actuators: bp.Actuators | None = None
        self.acting_actuators: bp.Actuators | None = None

    @property
    def has_motors(self) -> bool:
        """Whether the actuators have an effect on efforts or measurements."""
        actuators = self.acting_actuators
        return actuators is not None and (actuators.measures or actuators.delivers)

    def set_params(self, params: bp.PIDParams) -> None:
        """Put params into effect."""
        randomization = self._options.randomization
        robot = self._options.robot
        self.params = self.acting_params = params
        if randomization is not None:
            self.acting_params = randomization.randomized("params", params, self.draws, robot)

    def set_actuators(self, actuators: bp.Actuators | None) -> bp.Actuators | None:
        """Put actuators into effect; return them with the draws applied."""
        randomization = self._options.randomization
        robot = self._options.robot
        self.actuators = actuators
        if randomization is not None:
            actuators = randomization.randomized("actuators", actuators, self.draws, robot)
        self.acting_actuators = actuators
        return actuators


def make_pack(
    options: RunnerOptions,
    scene: SceneSpec,
    size: int,
    first_env: int,
    draws: Draws | None,
    workspace: object,
) -> EnginePack:
    """Return the pack of ``size`` envs; without ``draws`` all robots equal the model."""
    randomization = options.randomization
    make = options.load_engine().make_pack
    if randomization is None or not randomization.changes_robot:
        return make(scene, size, first_env, workspace=workspace)
    links = tuple(elements("link_mass", options.robot))
    scene = replace(scene, carrier=randomization.carrier(options.robot), varied_links=links)
    return make(scene, size, first_env, variation(options, size, draws), workspace)


def variation(options: RunnerOptions, size: int, draws: Draws | None) -> Variation:
    """Return the differences of ``size`` robots from the model."""
    randomization = options.randomization
    robot = options.robot
    assert randomization is not None
    values = {}
    for name in PHYSICAL:
        if getattr(randomization, name) is None:
            continue
        nominal = nominal_values(name, robot, options.mjcf)
        rows = np.tile(nominal, (size, 1))
        if draws is not None:
            rows = randomization.apply(name, nominal, draws, robot)
        # Masses vary by a factor, the others by their value.
        if name == "link_mass":
            rows = rows / nominal
        if name in ("payload", "ground_friction"):
            values[name] = rows[:, 0]
        else:
            values[name] = rows
    return Variation(**values)


class LinkSensors:
    """Quantities of ``size`` envs from the sensors of links, averaged over a tick, if ``options`` observe
    some.
    """

    def __init__(self, options: RunnerOptions, size: int) -> None:
        self.values: dict[str, Rows] = untouched(size, options.observed)
        """Quantities of :class:`batchpid.sim.Observation` in the last tick (size, ...), by name."""

    def begin(self, pack: EnginePack) -> None:
        """Begin a tick."""
        if self.values:
            pack.take_sensed()

    def end(self, pack: EnginePack, substeps: int, failed: Bool) -> None:
        """Take the means over a tick of ``substeps`` sim steps, 0 for ``failed`` envs (size,)."""
        sums = pack.take_sensed() if self.values else {}
        for name, rows in sums.items():
            values = self.values[name]
            if values.dtype == bool:
                values[...] = rows > 0
            else:
                values[...] = rows / substeps
            values[failed] = 0

    def clear(self, mask: Bool) -> None:
        """Set the values of the envs of ``mask`` (size,) to 0."""
        for values in self.values.values():
            values[mask] = 0


class Pushes:
    """Pushes of ``size`` envs at random times, if the randomization of ``options`` has some.

    A push comes at the beginning of the first tick after its time, at most one in a tick.
    """

    def __init__(self, options: RunnerOptions, size: int) -> None:
        self._options = options
        names = COUNTS if options.has_pushes else ()
        self.counts: dict[str, Int64] = {name: np.zeros(size, np.int64) for name in names}
        """Counts of each env (size,), by name of :data:`COUNTS`; empty without pushes."""

    def begin(self, mask: Bool, episodes: Int64) -> None:
        """Begin the episodes (envs, 2) of the envs of ``mask`` (envs,)."""
        for counts in self.counts.values():
            counts[mask] = 0
        self._take(np.flatnonzero(mask), episodes)

    def due(self, suspended: Bool, episodes: Int64) -> tuple[list[int], Float64]:
        """Return the envs that are pushed now, and the changes of their twists (n, 6)."""
        rows = np.flatnonzero((self.counts["steps"] >= self.counts["due"]) & ~suspended)
        if rows.size:
            twists = self._draw("push", rows, episodes)
        else:
            twists = np.zeros((0, 6))
        self.counts["number"][rows] += 1
        self._take(rows, episodes)
        return rows.tolist(), twists

    def _take(self, rows: NDArray[np.intp], episodes: Int64) -> None:
        """Set the time of the next push of envs ``rows``."""
        if self.counts and rows.size:
            intervals = self._draw("push_interval", rows, episodes)[:, 0]
            steps = np.ceil(np.minimum(intervals / self._options.timestep, 2.0**53))
            self.counts["due"][rows] += steps.astype(np.int64)

    def _draw(self, name: str, rows: NDArray[np.intp], episodes: Int64) -> Float64:
        randomization = self._options.randomization
        assert randomization is not None
        return randomization.next_push(
            name, self._options.robot, episodes[rows], self.counts["number"][rows]
        )
