"""The closed loop over some packs of scenes: read, compensate, control, write, step.

The same code runs in a worker process and in the caller's. A group of envs runs all its substeps
before the next group, so that its working set stays in the cache; nothing depends on how envs are
grouped.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Rows
from batchpid.errors import BatchPIDError, ControllerError, WorkerError
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.array_executors import ROWS
from batchpid.sim.loop.arrays import Arrays, Snapshot, join_rows
from batchpid.sim.loop.env_group import EnvGroup
from batchpid.sim.loop.env_parts import OwnController, make_pack
from batchpid.sim.loop.group_control import native_obstacle
from batchpid.sim.loop.native_executor import NativeExecutor, run_ticks
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import NOTHING, Draws


class Failure(Exception):
    """Error of a loop during a request. Whole ticks before it are valid; the state of the loop
    after it is undefined.

    It does not depend on how envs are divided among workers: of several failures, the first by
    :func:`order` is reported.

    Attributes
    ----------
    step
        Sim step since the start of the runner; the first one of the tick if it is not known.
    env
        First env of the group that failed.
    ticks
        Ticks of the request that were completed before the error.
    error
        The error.
    """

    def __init__(
        self,
        step: int,
        env: int,
        ticks: int,
        error: Exception,
    ) -> None:
        super().__init__(step, env, ticks, error)
        self.step = step
        self.env = env
        self.ticks = ticks
        self.error = error

    @classmethod
    def of(cls, error: Exception) -> Failure:
        """Return ``error`` if it is a Failure, else a Failure at step 0 with it."""
        if isinstance(error, Failure):
            return error
        return cls(0, 0, 0, error)

    def portable(self) -> Failure:
        """Return the failure with an error class of this project, which another process can raise,
        and the traceback.

        :meth:`of_worker` puts the name of the worker in front of the message of a WorkerError.
        """
        error = self.error
        text = "".join(traceback.format_exception(error))
        if isinstance(error, ControllerError):
            # A node of a cluster passes on the failure of its worker, which has its note.
            if not hasattr(error, "__notes__"):
                error.add_note(text)
        elif not isinstance(error, BatchPIDError):
            error = WorkerError(f"raised:\n{text}")
        return Failure(self.step, self.env, self.ticks, error)

    def of_worker(self, name: str) -> Failure:
        """Return the failure with the name of its worker in front of the message of a
        WorkerError.
        """
        if type(self.error) is WorkerError:
            self.error = WorkerError(f"{name} {self.error}")
        return self


def order(failure: Failure) -> tuple[int, int]:
    """Return the key by which failures are sorted: the earliest sim step first, then the lowest
    env.
    """
    return failure.step, failure.env


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
        self,
        options: RunnerOptions,
        params: bp.PIDParams,
        envs: slice,
        arrays: Arrays,
    ) -> None:
        self.options, self.arrays = options, arrays
        self._first_env = envs.start
        self._scene = options.scene
        self._steps = 0
        self._given: tuple[bool, ...] = ()
        self._workspace: dict[object, object] = {}
        if isinstance(options.control, str):
            controller = None
        else:
            controller = OwnController(options)
        count = envs.stop - envs.start
        size = group_size(options)
        self.groups = list[EnvGroup]()
        # Each group has its own scenes; nothing else in the loop depends on the grouping.
        for first in range(0, count, size):
            rows = slice(first, min(first + size, count))
            part = arrays.at((slice(None), rows))
            own_params = params.for_envs(rows)
            group = EnvGroup(
                self._build(rows),
                rows,
                own_params,
                options,
                controller,
                part,
            )
            self.groups.append(group)
        self.set_actuators(None if options.actuators is None else options.actuators.for_envs(envs))
        # Packs that share working memory cannot run in one native call.
        if self._workspace:
            self._batches = [[group] for group in self.groups]
        else:
            self._batches = [self.groups]

    def _build(self, envs: slice, draws: Draws | None = None) -> EnginePack:
        first = self.options.first_env + self._first_env + envs.start
        return make_pack(
            self.options,
            self._scene,
            envs.stop - envs.start,
            first,
            draws,
            self._workspace,
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
        for group in self.groups:
            rows = group.envs
            group.acting.draws = draws.for_envs(rows)
            start = None if base is None else base[rows]
            group.reset(mask[rows], qpos[rows], qvel[rows], self._steps, start)
            group.observe_first()

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight; the controller's state is kept."""
        for group in self.groups:
            group.set_params(params.for_envs(group.envs))

    def set_actuators(self, actuators: bp.Actuators | None) -> None:
        """Change the actuators in flight; their state is kept."""
        for group in self.groups:
            group.set_actuators(None if actuators is None else actuators.for_envs(group.envs))

    def add_chunk(self, chunk: NDArray[np.float64], latency: NDArray[np.float64]) -> None:
        """Add a chunk (envs, rows, dof) that is ``latency`` (envs,) [s] old to the plans."""
        for group in self.groups:
            group.add_chunk(chunk[group.envs], latency[group.envs])

    def run(self, ticks: int, substeps: int, given: tuple[bool, ...]) -> float:
        """Run ``ticks`` of ``substeps`` sim steps under the commands in their arrays; return the
        seconds it took.

        ``given`` says which arrays of the commands are given
        (:attr:`batchpid.sim.loop.arrays.Command.given`); the others are set to 0. Raises Failure
        if a group failed. The other groups complete the run, so that the first failure does not
        depend on grouping.
        """
        began = time.perf_counter()
        if given != self._given:
            self._given = given
            # The caller writes only what is given, so zeros stay until that changes.
            for table, is_given in zip(self.arrays.command, given, strict=True):
                if not is_given:
                    table[...] = 0
        failures = list[Failure]()
        for groups in self._batches:
            executors = list[NativeExecutor]()
            for group in groups:
                executors += group.start(given[1], self._steps)
            # First whole ticks of all groups in one native call, then the rest of each group.
            run_ticks(executors, ticks, substeps)
            for group in groups:
                try:
                    group.finish(ticks, substeps)
                except Exception as error:  # of a controller, or of the engine
                    failures.append(self._failure(error, group, substeps))
        if failures:
            raise min(failures, key=order)
        self._steps += ticks * substeps
        return time.perf_counter() - began

    def _failure(self, error: Exception, group: EnvGroup, substeps: int) -> Failure:
        """Return the failure of a group in a run of ticks of ``substeps``."""
        steps = self._steps + group.tick * substeps
        step = steps + 1
        if isinstance(error, ControllerError):
            step = steps + error.step
            error = error.at(step, self.options.timestep)
        return Failure(step, self._first_env + group.envs.start, group.tick, error)

    def snapshot(self) -> dict[str, Rows]:
        """Return the state of every env, arrays by name. It is a barrier: the loop goes on as if
        restored from it.
        """
        parts = [group.read() for group in self.groups]
        for group, rows in zip(self.groups, parts, strict=True):
            acting = group.acting
            self._restore(group, rows, acting.params, acting.actuators, acting.draws)
        return join_rows(parts)

    def restore(self, snapshot: Snapshot, draws: Draws) -> None:
        """Put every env into its state in ``snapshot``, with its params and ``draws``."""
        self._steps = snapshot.steps
        for group in self.groups:
            envs, motors = group.envs, snapshot.actuators
            motors = None if motors is None else motors.for_envs(envs)
            params = snapshot.params.for_envs(envs)
            rows = {name: array[envs] for name, array in snapshot.rows.items()}
            self._restore(group, rows, params, motors, draws.for_envs(envs))
            group.observe_first()

    def _restore(
        self,
        group: EnvGroup,
        rows: dict[str, Rows],
        params: bp.PIDParams,
        actuators: bp.Actuators | None,
        draws: Draws | None,
    ) -> None:
        # The contact caches of some engines, and the order in which they solve contacts, depend on
        # the past. A new world has no past.
        randomization = self.options.randomization
        pack = group.pack
        varies = randomization is not None and randomization.changes_robot
        if varies or "complete_state" not in self.options.load_engine().capabilities:
            pack.close()
            pack = self._build(group.envs, draws)
        group.write(pack, rows, params, actuators, draws)

    def read(self) -> dict[str, Rows]:
        """Return the state of every env, arrays by name."""
        return join_rows([group.read() for group in self.groups])

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


def group_size(options: RunnerOptions) -> int:
    """Return the number of envs of a group, which changes no result."""
    engine = options.load_engine()
    obstacle = engine.native_obstacle() or native_obstacle(options)
    # Calls of NumPy and JAX have an overhead, which more envs share.
    if obstacle or options.backend != "numpy":
        return max(engine.group_size, ROWS)
    return engine.group_size
