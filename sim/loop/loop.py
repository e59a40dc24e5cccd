"""The closed loop over some packs of scenes: read, compensate, control, write, step.

The same code runs in a worker process and in the caller's. A group of envs runs all its substeps
before the next group, so that its working set stays in the cache; nothing depends on how envs are
grouped.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Rows
from batchpid.errors import ControllerError
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.loop.acting_draws import make_pack
from batchpid.sim.loop.arrays import Arrays, Ticks
from batchpid.sim.loop.custom import OwnController
from batchpid.sim.loop.env_group import EnvGroup
from batchpid.sim.loop.failure import Failure, RunError, order
from batchpid.sim.loop.snapshot import EnvStates, Snapshot
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import NOTHING, Draws


class Loop:
    """Closed loop of some envs of a runner, with their scenes.

    Parameters
    ----------
    options
        Options of the runner.
    params
        PID parameters of these envs: one row, or one row each.
    envs
        Rows of the runner's envs.
    arrays
        Input and output (ticks, envs, ...) of these envs, for the ticks of a :meth:`run`. The other
        methods write to the first tick.
    """

    def __init__(
        self, options: RunnerOptions, params: bp.PIDParams, envs: slice, arrays: Arrays
    ) -> None:
        robot = options.robot
        self.options, self.arrays = options, arrays
        self.ticks = Ticks(arrays)
        """Input and output of each tick."""
        self._first_env = envs.start
        self._scene = SceneSpec(
            tables=robot.tables,
            ignored=robot.ignored_pairs,
            joints=robot.joints,
            dissipation=robot.dissipation,
            fixed_base=robot.fixed_base,
            mjcf=options.mjcf,
            **options.values_for("scene"),
        )
        self._steps = 0
        self._workspace: dict[Any, Any] = {}
        count, size = envs.stop - envs.start, options.load_engine().group_size
        slices = [slice(start, min(start + size, count)) for start in range(0, count, size)]
        controller = None if isinstance(options.control, str) else OwnController(options)
        self.groups = [
            EnvGroup(self._build(group), group, params.for_envs(group), options, controller)
            for group in slices
        ]
        self.set_actuators(None if options.actuators is None else options.actuators.for_envs(envs))
        self._group_ticks = [Ticks(arrays.at((slice(None), group))) for group in slices]

    def _build(self, envs: slice, draws: Draws | None = None) -> EnginePack:
        first = self.options.first_env + self._first_env + envs.start
        return make_pack(
            self.options, self._scene, envs.stop - envs.start, first, draws, self._workspace
        )

    def reset(
        self,
        mask: NDArray[np.bool_],
        qpos: NDArray[np.float64],
        qvel: NDArray[np.float64],
        draws: Draws = NOTHING,
        base: NDArray[np.float64] | None = None,
    ) -> None:
        """Place the envs of ``mask`` (envs,) at ``qpos``, ``qvel`` (envs, dof), with a fresh
        controller state.

        Floating bases are placed at ``base`` (envs, 13): pose and twist. None is the origin.
        ``draws`` apply to all envs from now on; they differ from the previous draws in these envs
        alone.
        """
        for group, ticks in zip(self.groups, self._group_ticks, strict=True):
            group.draws = draws.for_envs(group.envs)
            own = None if base is None else base[group.envs]
            group.reset(mask[group.envs], qpos[group.envs], qvel[group.envs], self._steps, own)
            group.observe(ticks[0])

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight; the controller's state is kept."""
        for group in self.groups:
            group.set_params(params.for_envs(group.envs))

    def set_actuators(self, actuators: bp.Actuators | None) -> None:
        """Change the actuators in flight; their state is kept."""
        for group in self.groups:
            group.set_actuators(None if actuators is None else actuators.for_envs(group.envs))

    def run(self, ticks: int, substeps: int, given: tuple[bool, ...]) -> float:
        """Run ``ticks`` of ``substeps`` sim steps under the commands in their arrays; return the
        seconds it took.

        ``given`` says which arrays of the commands are used
        (:attr:`batchpid.sim.loop.arrays.Command.given`). Raises RunError if a group failed. The
        other groups complete the run, so that the first failure does not depend on grouping.
        """
        began = time.perf_counter()
        failures = []
        for group, group_ticks in zip(self.groups, self._group_ticks, strict=True):
            done = 0
            try:
                while done < ticks:
                    done = group.run(
                        group_ticks, given, done, ticks, substeps, self._steps + done * substeps
                    )
            except Exception as error:
                failures.append(self._failure(error, group, done, self._steps + done * substeps))
        if failures:
            raise RunError(min(failures, key=order))
        self._steps += ticks * substeps
        return time.perf_counter() - began

    def _failure(self, error: Exception, group: EnvGroup, ticks: int, steps: int) -> Failure:
        """Return the failure of a group after ``ticks`` whole ticks of a run; ``steps`` counts from
        the start.
        """
        step = steps + 1
        if isinstance(error, ControllerError):
            step = steps + error.step
            error = error.at(step, self.options.timestep)
        return Failure(step, self._first_env + group.envs.start, ticks, error)

    def snapshot(self) -> EnvStates:
        """Return the state of every env. It is a barrier: the loop goes on as if restored from
        it.
        """
        states = EnvStates.join([group.read() for group in self.groups])
        self._place(states)
        return states

    def restore(self, snapshot: Snapshot, draws: Draws) -> None:
        """Put every env into its state in ``snapshot``, with its params and ``draws``."""
        self._steps = snapshot.steps
        for group in self.groups:
            envs, motors = group.envs, snapshot.actuators
            motors = None if motors is None else motors.for_envs(envs)
            group.adopt(snapshot.params.for_envs(envs), motors, draws.for_envs(envs))
        self._place(snapshot.states)
        for group, ticks in zip(self.groups, self._group_ticks, strict=True):
            group.observe(ticks[0])

    def _place(self, states: EnvStates) -> None:
        # The contact caches of some engines, and the order in which they solve contacts, depend on
        # the past. A new world has no past.
        varies = self.options.randomization is not None and self.options.randomization.changes_robot
        for group in self.groups:
            pack = group.pack
            if varies or not pack.state_is_complete:
                pack.close()
                pack = self._build(group.envs, group.draws)
            group.write(pack, states.for_envs(group.envs))

    def state_sizes(self) -> list[int]:
        """Return the number of values in the engine's state of each env."""
        return [size for group in self.groups for size in group.pack.state_sizes()]

    def poses(self, names: Sequence[str] | None = None) -> list[Rows]:
        """Return the poses of the entities that ``build`` returned for each env, or of bodies
        ``names``, (..., 7).
        """
        return [rows for group in self.groups for rows in group.pack.read_poses(names)]

    def close(self) -> None:
        """Free the scenes."""
        for group in self.groups:
            group.pack.close()
        self.groups = []
