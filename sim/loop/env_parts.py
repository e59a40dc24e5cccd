"""Parts of a group of envs: its pack, pushes of bases, and the caller's own controller, called at
every sim step with the state of the group.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Array, Bool, Document, Float64
from batchpid.arrays.elementwise import namespace, precision, read_only
from batchpid.arrays.trees import flatten, unflatten
from batchpid.errors import ControllerError, InvalidArgumentError
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.engine.scene_spec import Variation
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import Draws, elements, nominal_values
from batchpid.sim.randomization.randomization import PHYSICAL
from batchpid.sim.tool_space import OperationalSpace

Int64 = NDArray[np.int64]
COUNTS = ("steps", "due", "number")
"""Counters of an env: sim steps since the reset, the sim step of the next push, and the number of
pushes so far.
"""


def make_pack(
    options: RunnerOptions,
    size: int,
    first_env: int,
    workspace: object,
    draws: Draws | None,
) -> EnginePack:
    """Return the pack of ``size`` envs; without ``draws`` all robots equal the model."""
    randomization = options.randomization
    make = options.load_engine().make_pack
    if randomization is None or not randomization.changes_robot:
        return make(options.scene, size, first_env, workspace=workspace)
    links = tuple(elements("link_mass", options.robot))
    scene = replace(options.scene, carrier=randomization.carrier(options.robot), varied_links=links)
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


class Pushes:
    """Pushes of ``size`` envs at random times, if the randomization of ``options`` has some.

    A push comes at the beginning of the first tick after its time, at most one in a tick.
    """

    def __init__(self, options: RunnerOptions, size: int) -> None:
        self._options = options
        names = COUNTS if getattr(options.randomization, "push", None) else ()
        self.counts: dict[str, Int64] = {name: np.zeros(size, np.int64) for name in names}
        """Counts of each env (size,), by name of :data:`COUNTS`; empty without pushes."""

    def begin(self, mask: Bool, episodes: Int64) -> None:
        """Begin the episodes (envs, 2) of the envs of ``mask`` (envs,)."""
        for counts in self.counts.values():
            counts[mask] = 0
        self._take(np.flatnonzero(mask), episodes)

    def push(
        self,
        pack: EnginePack,
        suspended: Bool,
        episodes: Int64,
        substeps: int,
    ) -> bool:
        """Push the bases that are due before a tick of ``substeps`` sim steps; return whether there
        are some.
        """
        rows = np.flatnonzero((self.counts["steps"] >= self.counts["due"]) & ~suspended)
        if rows.size:
            pack.push(rows.tolist(), self._draw("push", rows, episodes))
            self.counts["number"][rows] += 1
            self._take(rows, episodes)
        self.counts["steps"] += substeps
        return bool(rows.size)

    def _take(self, rows: NDArray[np.intp], episodes: Int64) -> None:
        """Set the time of the next push of envs ``rows``."""
        if self.counts and rows.size:
            intervals = self._draw("push_interval", rows, episodes)[:, 0]
            steps = np.ceil(np.minimum(intervals / self._options.timestep, 2.0**53))
            self.counts["due"][rows] += steps.astype(np.int64)

    def _draw(self, name: str, rows: NDArray[np.intp], episodes: Int64) -> Float64:
        randomization = self._options.randomization
        assert randomization is not None
        number = self.counts["number"][rows]
        drawn = randomization.draw_field(name, self._options.robot, episodes[rows], number)
        return np.nan_to_num(drawn)


class OwnController:
    """Caller's own controller (:class:`batchpid.sim.Controller`), checked; its state is a
    dictionary of arrays by name.

    All groups of envs share it, and thus its JAX program.
    """

    def __init__(self, options: RunnerOptions) -> None:
        assert not isinstance(options.control, str)
        self._options = options
        self._controller = options.control
        self.name = type(options.control).__name__
        self.implicit = getattr(options.control, "implicit", False)
        self._reporting: Callable[..., tuple[Array, ...]] | None = None
        # The law of a subclass is its __call__.
        if type(options.control) is OperationalSpace:
            self._reporting = options.control.advance
        self._structure: Any = None
        self._first: Document = {}

    def init(self, envs: int) -> Document:
        """Return a checked copy of the controller's initial state for ``envs`` envs.

        Raises ControllerError if the controller fails, an array of the state does not have the envs
        as its first axis, or the state has other arrays than at the first start.
        """
        with controller_errors(self):
            state = _begin(self._options, envs)
            arrays = {name: np.array(leaf) for name, leaf in flatten(state).items()}
            if self._structure is None:
                # The structure stays the same; between sim steps only its arrays are kept, by name.
                self._structure, self._first = state, arrays
            return _like(self._first, arrays, envs)

    def __call__(self, state: Document, *inputs: Array) -> tuple[Array, ...]:
        """Return the new state and the effort (M, dof); inputs are setpoint, qpos, qvel, passive
        force, and the time to the end of the tick, which only operational-space control takes.

        Operational-space control limits efforts itself; a third result are the joints with limited
        efforts (M, dof).

        Raises InvalidArgumentError if the controller returned an effort or a state of a wrong shape
        or dtype.
        """
        qpos = inputs[1]
        xp = namespace(qpos)
        if xp is np:
            # The controller may keep them, but not write to them.
            inputs = tuple([read_only(np.array(rows)) for rows in inputs])
        new, returned, *limited = self._called(unflatten(self._structure, state), *inputs)
        # Copies: the controller may change its own arrays at any time.
        arrays = _like(state, flatten(new, read=xp.array), len(qpos))
        effort = _like({"effort": qpos}, {"effort": xp.array(returned, qpos.dtype)}, len(qpos))
        return arrays, effort["effort"], *limited

    def _called(self, *arguments: Any) -> tuple[Array, ...]:
        if self._reporting is not None:
            return self._reporting(*arguments)
        state, effort = self._controller(*arguments[:-1])
        return state, effort


@contextmanager
def controller_errors(controller: OwnController | None, step: int = 0) -> Iterator[None]:
    """Convert errors in sim step ``step`` of a tick to ControllerErrors, unless ``controller`` is
    None.
    """
    try:
        yield
    except Exception as error:
        if controller is None:
            raise
        raise ControllerError(controller.name, error, step) from error


def _begin(options: RunnerOptions, envs: int) -> Any:
    """Return the initial state of the caller's own controller for ``envs`` envs."""
    assert not isinstance(options.control, str)
    init: Callable[..., Any] = options.control.init
    arguments: tuple[Any, ...] = (options.robot, envs, options.timestep)
    # A controller without a time step of its own may leave the last argument out.
    try:
        inspect.signature(init).bind(*arguments)
    except TypeError:
        arguments = arguments[:2]
    if options.backend != "jax":
        return init(*arguments)
    # Its arrays have this dtype, not JAX's default in this process.
    with precision("float64"):
        state = init(*arguments)
        return unflatten(state, flatten(state))


def _like(before: Document, leaves: Document, envs: int) -> Document:
    """Return the arrays that a controller returned for ``envs`` envs in the dtypes of ``before``.

    Raises InvalidArgumentError if names or shapes differ, or a dtype cannot be cast.
    """
    for name in {**before, **leaves}:
        old: Any = before.get(name)
        new: Any = leaves.get(name)
        is_there = old is not None and new is not None
        is_fit = is_there and new.shape == (envs, *old.shape[1:])
        if is_fit and np.can_cast(new.dtype, old.dtype, "same_kind"):
            continue
        # Without the number of envs, which is that of a group.
        returned = "no array" if new is None else f"{new.dtype} {new.shape[1:]} per env"
        raise InvalidArgumentError(
            "control",
            f"returned {name!r} of {returned}",
            remedy="return (state, effort): a state as init does, an effort of shape (envs, dof)",
        )
    return {name: leaf.astype(before[name].dtype, copy=False) for name, leaf in leaves.items()}
