"""Control by the caller's own controller, called at every sim step with the state of a group of envs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from sim.engine.building import SceneSpec
from sim.engine.pack import Pack
from sim.loop.control import CONTROLS, Control, Plant
from sim.options import Controller, RunnerOptions
from sim.robot.robot import Robot

Float64 = NDArray[np.float64]


class CustomControl(Control):
    """qf = sat(the controller's effort), with the limits of the params; see :class:`sim.options.Controller`."""

    def __init__(
        self, controller: Controller, robot: Robot, scene: SceneSpec, params: bp.PIDParams, plant: Plant
    ) -> None:
        self._controller, self._robot = controller, robot
        super().__init__(scene, params, plant)
        self._of_controller = controller.init(robot, len(self.saturated))
        self._check(flatten(self._of_controller))

    def _check(self, leaves: Mapping[str, NDArray[Any]]) -> None:
        for name, leaf in leaves.items():
            if leaf.shape[:1] != self.saturated.shape[:1]:
                raise InvalidArgumentError(
                    "control",
                    f"init returned a state{name and ' ' + name} of shape {leaf.shape}, for {len(self.saturated)} envs",
                    remedy="let every array of the state have the envs as its first axis",
                )

    def reset(self, qpos: Float64, mask: NDArray[np.bool_]) -> None:
        """Reset the state of the envs of ``mask`` (M,), which are at ``qpos``."""
        self.saturated[mask] = False
        fresh = flatten(self._controller.init(self._robot, len(mask)))
        leaves = {name: np.array(leaf) for name, leaf in flatten(self._of_controller).items()}
        for name, leaf in leaves.items():
            leaf[mask] = fresh[name][mask]
        self._of_controller = unflatten(self._of_controller, leaves)

    def effort(self, qpos: Float64, feedforward: Float64 | None, step: int, qvel: Float64 | None = None) -> Float64:
        """Call the controller, and saturate."""
        qvel = self._plant.read_qvel() if qvel is None else qvel
        passive = np.zeros_like(qpos) if feedforward is None else feedforward
        setpoint = self._command.setpoint
        self._of_controller, wanted = self._controller(self._of_controller, setpoint, qpos, qvel, passive)
        total = np.asarray(wanted, np.float64)
        if total.shape != qpos.shape:
            problem = f"returned an effort of shape {total.shape}, not {qpos.shape}"
            raise InvalidArgumentError("control", problem, remedy="return (state, effort), effort of shape (envs, dof)")
        if self._coupling is not None:
            total = self._coupling.efforts(total)
        effort = self._saturate(total)
        if step + 1 == self._substeps:
            self.saturated = effort != total
        return effort

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of the controller's state by name."""
        return flatten(self._of_controller)

    def write(self, state: dict[str, NDArray[Any]], saturated: NDArray[np.bool_]) -> None:
        """Set the controller's state, and :attr:`saturated`."""
        self._of_controller, self.saturated = unflatten(self._of_controller, state), saturated


def make_control(options: RunnerOptions, scene: SceneSpec, params: bp.PIDParams, plant: Pack) -> Control:
    """Return the control that ``options`` ask for, of the robots ``plant``."""
    if isinstance(options.control, str):
        return CONTROLS[options.control](scene, params, plant)
    return CustomControl(options.control, options.robot, scene, params, plant)


def initial_state(options: RunnerOptions, params: bp.PIDParams) -> dict[str, NDArray[Any]]:
    """Return the state of the control of all envs at their start, by name."""
    if not isinstance(options.control, str):
        return flatten(options.control.init(options.robot, options.num_envs))
    return bp.init(params, np.zeros((options.num_envs, options.robot.dof), np.float32)).leaves()


def flatten(state: Any, name: str = "") -> dict[str, NDArray[Any]]:
    """Return the arrays of a nested state by name: keys of mappings and fields of tuples, joined by "/"."""
    if state is None:
        return {}
    if not isinstance(state, Mapping | tuple | list):
        return {name or "state": np.asarray(state)}
    return {
        leaf: rows
        for key, part in _items(state)
        for leaf, rows in flatten(part, f"{name}/{key}" if name else key).items()
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
