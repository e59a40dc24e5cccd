"""Control by the caller's own controller, called at every sim step with the state of a group of envs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.errors import ControllerError, InvalidArgumentError
from batchpid.jax_settings import own_settings
from batchpid.read_only import read_only
from sim.engine.scene_spec import SceneSpec
from sim.loop.control import Control, Plant
from sim.options import Controller, RunnerOptions

Float64 = NDArray[np.float64]


class CustomControl(Control):
    """qf = sat(the controller's effort), with the limits of the params; see :class:`sim.options.Controller`."""

    def __init__(self, options: RunnerOptions, scene: SceneSpec, params: bp.PIDParams, plant: Plant) -> None:
        self.options, self._controller = options, own_controller(options)
        super().__init__(scene, params, plant)
        self._of_controller = self._init()
        self._like = flatten(self._of_controller)
        self.returned = np.zeros(self.saturated.shape)

    def _init(self) -> Any:
        """Return a copy of the controller's state at the start, checked."""
        state = _begin(self.options, len(self.saturated))
        leaves = {name: np.array(leaf) for name, leaf in flatten(state).items()}
        for name, leaf in leaves.items():
            if leaf.shape[:1] != self.saturated.shape[:1]:
                raise InvalidArgumentError(
                    "control",
                    f"init returned a state{name and ' ' + name} of shape {leaf.shape}, for {len(self.saturated)} envs",
                    remedy="let every array of the state have the envs as its first axis",
                )
        return unflatten(state, leaves)

    def reset(self, qpos: Float64, mask: NDArray[np.bool_]) -> None:
        """Reset the state of the envs of ``mask`` (M,), which are at ``qpos``."""
        self.saturated[mask] = False
        with controller_errors(self._controller):
            fresh = _like(self._like, flatten(self._init()))
        leaves = {name: np.array(leaf) for name, leaf in flatten(self._of_controller).items()}
        for name, leaf in leaves.items():
            leaf[mask] = fresh[name][mask]
        self._of_controller = unflatten(self._of_controller, leaves)

    def _call(self, *inputs: Float64) -> Any:
        """Return the controller's effort, and keep its state."""
        own = (read_only(np.array(rows)) for rows in inputs)  # the controller may keep them, but not write to them
        state, wanted = self._controller(self._of_controller, *own)
        self._of_controller = unflatten(self._of_controller, _like(self._like, flatten(state, read=np.array)))
        return wanted

    def call(self, leaves: Mapping[str, Any], *inputs: Any) -> tuple[dict[str, Any], Any]:
        """Call the controller in a program of JAX; return its state by name, and the effort.

        Raises
        ------
        InvalidArgumentError
            JAX cannot trace it, or it returns something else.
        """
        import jax

        qpos = inputs[1]
        try:
            state, wanted = self._controller(unflatten(self._of_controller, leaves), *inputs)
            new = _like(leaves, flatten(state, read=jax.numpy.asarray))
            effort = jax.numpy.asarray(wanted, qpos.dtype)
        except (TypeError, jax.errors.JAXTypeError, jax.errors.JAXIndexError) as error:
            raise InvalidArgumentError(
                "control",
                f"cannot be traced by JAX: {str(error).splitlines()[0]}",
                remedy="write it in jax.numpy, or use backend='numpy'",
            ) from error
        _check_effort(effort, qpos)
        return new, effort

    def effort(self, qpos: Float64, feedforward: Float64 | None, step: int, qvel: Float64 | None = None) -> Float64:
        """Call the controller, and saturate.

        Raises
        ------
        ControllerError
            The controller raised, or returned something unusable.
        """
        qvel = self._plant.read_qvel() if qvel is None else qvel
        passive = np.zeros_like(qpos) if feedforward is None else feedforward
        setpoint = self._command.setpoint
        with controller_errors(self._controller, step + 1):
            total = np.array(self._call(setpoint, qpos, qvel, passive), np.float64)
            _check_effort(total, qpos)
        self.returned = total
        if self._coupling is not None:
            total = self._coupling.efforts(total)
        effort = self.saturate(total)
        if step + 1 == self._substeps:
            self.saturated = effort != total
        return effort

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the controller's state by name."""
        return flatten(self._of_controller)

    def write(self, state: dict[str, NDArray[Any]], saturated: NDArray[np.bool_]) -> None:
        """Set the controller's state, and :attr:`saturated`."""
        self._of_controller, self.saturated = unflatten(self._of_controller, state), saturated


def initial_state(options: RunnerOptions, params: bp.PIDParams) -> dict[str, NDArray[Any]]:
    """Return the state of the control of all envs at their start, by name."""
    if not isinstance(options.control, str):
        return flatten(_begin(options, options.num_envs))
    return bp.init(params, np.zeros((options.num_envs, options.robot.dof), np.float32)).leaves()


@contextmanager
def controller_errors(controller: object, step: int = 0) -> Iterator[None]:
    """Convert errors in sim step ``step`` of a tick to ControllerErrors, unless ``controller`` is None."""
    try:
        yield
    except Exception as error:
        if controller is None:
            raise
        raise ControllerError(type(controller).__name__, error, step) from error


def own_controller(options: RunnerOptions) -> Controller:
    """Return the caller's own controller."""
    assert not isinstance(options.control, str)
    return options.control


def _begin(options: RunnerOptions, envs: int) -> Any:
    """Return the state of the caller's own controller at the start of ``envs`` envs."""
    start = partial(own_controller(options).init, options.robot, envs)
    if options.backend != "jax":
        return start()
    with own_settings(options.dtype):  # its arrays have this dtype, not JAX's default in this process
        return unflatten(state := start(), flatten(state))


def _check_effort(effort: Any, qpos: Any) -> None:
    if effort.shape != qpos.shape:
        rows = effort.shape[:1] == qpos.shape[:1]  # their number depends on how envs are grouped
        got, wanted = (f"(envs{''.join(f', {n}' for n in a.shape[1:])})" if rows else a.shape for a in (effort, qpos))
        problem = f"returned an effort of shape {got}, not {wanted}"
        raise InvalidArgumentError("control", problem, remedy="return (state, effort), effort of shape (envs, dof)")


def _like(before: Mapping[str, Any], leaves: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arrays of a controller's state in the dtypes of ``before``.

    Raises
    ------
    InvalidArgumentError
        They have other names or shapes, or a dtype that does not fit.
    """
    new = {}
    for name in dict.fromkeys([*before, *leaves]):
        old, leaf = before.get(name), leaves.get(name)
        if old is None or leaf is None:
            problem = f"returned a state {'without' if leaf is None else 'with an unknown'} {name!r}"
        elif leaf.shape != old.shape:
            problem = f"returned a state {name!r} of shape {leaf.shape}, not {old.shape}"
        elif leaf.dtype == old.dtype:
            new[name] = leaf
            continue
        elif np.can_cast(leaf.dtype, old.dtype, "same_kind"):
            new[name] = leaf.astype(old.dtype)
            continue
        else:
            problem = f"returned a state {name!r} of {leaf.dtype}, which does not fit into {old.dtype}"
        raise InvalidArgumentError("control", problem, remedy="return a state as init does")
    return new


def flatten(state: Any, name: str = "", read: Callable[[Any], Any] = np.asarray) -> dict[str, Any]:
    """Return the arrays of a nested state by name: keys of mappings and fields of tuples, joined by "/"."""
    if state is None:
        return {}
    if not isinstance(state, Mapping | tuple | list):
        return {name or "state": read(state)}
    return {
        leaf: rows
        for key, part in _items(state)
        for leaf, rows in flatten(part, f"{name}/{key}" if name else key, read).items()
    }


def unflatten(like: Any, leaves: Mapping[str, NDArray[Any]], name: str = "") -> Any:
    """Return a state of the structure of ``like`` with the arrays ``leaves``."""
    if like is None:
        return None
    if not isinstance(like, Mapping | tuple | list):
        return leaves[name or "state"]
    parts = {key: unflatten(part, leaves, f"{name}/{key}" if name else key) for key, part in _items(like)}
    if isinstance(like, Mapping):
        return dict(zip(like, parts.values(), strict=True))
    return type(like)(**parts) if hasattr(like, "_fields") else type(like)(parts.values())


def _items(state: Any) -> list[tuple[str, Any]]:
    if isinstance(state, Mapping):
        return [(str(key), part) for key, part in state.items()]
    names = getattr(state, "_fields", None) or map(str, range(len(state)))
    return list(zip(names, state, strict=True))
