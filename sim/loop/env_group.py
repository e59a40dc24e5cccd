"""Group of envs that advance together: one pack, its control, and what both show and remember.

An executor runs the sim steps. The group handles what happens between them: a possible failure, a
command that is not finite, a push, the sensors of links, a reset, new params.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64, Rows
from batchpid.arrays.elementwise import clip, replace_envs
from batchpid.arrays.trees import flatten, leaves, structure, unflatten
from batchpid.sim.loop.array_executors import NumPyExecutor
from batchpid.sim.loop.arrays import Arrays, Snapshot
from batchpid.sim.loop.env_parts import OwnController, Pushes, make_pack, variation
from batchpid.sim.loop.faults import FaultContainment, are_finite, is_near
from batchpid.sim.loop.group_control import GroupControl
from batchpid.sim.loop.native_executor import NativeExecutor, make_executor, run_ticks
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import Draws
from batchpid.sim.signals import untouched
from batchpid.stages.stage import adopted, by_name, started


class EnvGroup:
    """One pack and its control; runs the sim steps of ticks, and suspends or resets envs that fail.

    Parameters
    ----------
    options
        Options of the runner.
    envs, rows
        Rows of the envs among those of the runner, and in the arrays of the loop.
    controller
        The caller's own, or None.
    arrays
        Input and output (ticks, envs, ...) of these envs.
    workspace
        Working memory of the engine, which the groups of a loop share.

    Attributes
    ----------
    tick
        First tick of the run that is not complete.
    steps
        Sim steps before the run.
    """

    _executor: NumPyExecutor | NativeExecutor

    def __init__(
        self,
        options: RunnerOptions,
        envs: slice,
        rows: slice,
        controller: OwnController | None,
        arrays: Arrays,
        workspace: object,
    ) -> None:
        self.rows = rows
        self.tick = self.steps = 0
        self._step = 0  # sim steps of the tick that are done
        self._moves = False  # whether the run gives rates of setpoints
        self._runs_whole = False  # whether the native code runs whole ticks
        self._options = options
        self._controller = controller
        self._arrays = arrays
        self._at = cache(arrays.at)  # views at a tick
        size = envs.stop - envs.start
        first_env = options.first_env + envs.start
        self._make_pack = partial(make_pack, options, size, first_env, workspace)
        self.pack = self._make_pack(None)
        # As they are given; the control has them with the draws of the randomization.
        self._params = options.params.for_envs(envs)
        actuators = options.actuators
        self._actuators = None if actuators is None else actuators.for_envs(envs)
        self._draws: Draws | None = None
        self._faults = FaultContainment(size, options)
        self._pushes = Pushes(options, size)
        self._episode = np.zeros(size, np.int64)
        # Results of the last sim step, which outlive executors: native code writes them in each tick.
        shape = (size, self.pack.dof)
        links = untouched(size, options.observed)
        self._sensed = bool(links)
        self._shown: dict[str, Rows] = {
            "effort": np.zeros(shape, np.float32),
            "saturated": np.zeros(shape, bool),
            "guarded": np.zeros(shape, bool),
        } | links
        spec = self.pack.spec
        reads_base = "base_state" in options.load_engine().capabilities and spec.mjcf is None
        is_read = spec.is_alone or (reads_base and not spec.fixed_base)
        # A native controller takes setpoints from Python.
        needs_python = self._sensed or self._pushes.counts or controller is not None
        self._observes_natively = is_read and not needs_python
        if actuators is not None:
            self._write_joints()
        self._make_control(goes_on=False)

    def _acting(self) -> tuple[bp.PIDParams, bp.Actuators | None]:
        """Return params and actuators with the draws of the randomization."""
        randomization, robot = self._options.randomization, self._options.robot
        params, actuators = self._params, self._actuators
        if randomization is not None:
            params = randomization.randomized("params", params, self._draws, robot)
            actuators = randomization.randomized("actuators", actuators, self._draws, robot)
        return params, actuators

    def _make_control(self, goes_on: bool = True) -> None:
        """Make the control of the present robots, params and actuators, with its executor. If it
        ``goes_on``, the states of the stages carry over; otherwise the stages start.
        """
        setup = GroupControl.of(self._options, self.pack, *self._acting(), self._controller)
        stages = setup.stages
        if goes_on:
            executor = self._executor
            pairs = zip(executor.setup.stages, executor.read_state(), strict=True)
            by_names = {stage.name: (stage, state) for stage, state in pairs}
            states = adopted(stages, by_names, setup.values(self._episode))
        else:
            states = started(stages, setup.values(self._episode))
        tables = self._arrays, self._shown, self._faults.rows
        self._executor = make_executor(setup, states, *tables)
        setup.write_drives()

    # -- changes between ticks

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight; the controller's state carries on."""
        self._params = params
        self._make_control()

    def add_chunk(self, chunk: Float64, latency: Float64) -> None:
        """Add a chunk (M, rows, dof) that is ``latency`` (M,) [s] old to the plan."""
        self._executor.add_chunk(chunk, latency)

    def _write_joints(self, rows: list[int] | None = None) -> None:
        """Write the motors' armature, and their friction behind the gear, to the engine's joints, of
        the robots ``rows`` or all.
        """
        _, actuators = self._acting()
        self.pack.write_joints(actuators, rows)

    def reset(
        self,
        mask: NDArray[np.bool_],
        qpos: Float64,
        qvel: Float64,
        draws: Draws,
        base: Float64 | None,
    ) -> None:
        """Place the envs of ``mask`` (M,) at ``qpos`` and ``qvel`` (M, dof), with a fresh
        controller state.

        Floating bases are placed at ``base`` (M, 13): pose and twist. ``draws`` apply to all envs
        from now on; they differ from the previous draws in these envs alone.
        """
        self._draws = draws
        if mask.any():
            faults = self._faults
            faults.clear(mask)
            self._vary(mask, draws)
            faults.take_starts(mask, qpos, qvel, base)
            self._place(mask, faults.start_qpos, faults.start_qvel)
        self.observe(self._at(0))

    def _vary(self, mask: NDArray[np.bool_], draws: Draws) -> None:
        """Put the draws of the envs of ``mask`` (M,) into effect, before these envs are placed."""
        randomization = self._options.randomization
        if randomization is None:
            return
        rows = np.flatnonzero(mask).tolist()
        # The robots first: friction and inertia of the motors add to theirs.
        if randomization.changes_robot:
            self.pack.vary(rows, variation(self._options, len(rows), draws.for_envs(rows)))
        self._write_joints(rows)
        self._make_control()

    # -- ticks

    def start(self, moves: bool) -> list[NativeExecutor]:
        """Start a run at tick 0; return the executor if native code runs whole ticks.

        ``moves`` says whether the commands give rates of setpoints.
        """
        self.tick = 0
        self._moves = moves and self._options.sets_positions
        return self._start()

    def _start(self) -> list[NativeExecutor]:
        """Start the next tick; return the executor if native code can run it, else nothing."""
        self._step = 0
        # A suspended env needs neutral commands, which only Python gives.
        is_quiet = self._faults.begin_tick()
        executor = self._executor
        self._runs_whole = False
        if not isinstance(executor, NativeExecutor):
            return []
        if not (is_quiet and self._observes_natively):
            return []
        self._runs_whole = True
        executor.start(self._moves, 0, self.tick)
        return [executor]

    def finish(self, ticks: int, substeps: int) -> None:
        """Run the rest of ``ticks`` of ``substeps`` sim steps, after the common native call for
        whole ticks.
        """
        while True:
            # A native call has ended at the last tick, or at an event within a tick.
            if self._runs_whole:
                assert isinstance(self._executor, NativeExecutor)
                self._runs_whole = False
                self.tick, self._step = self._executor.complete()
            if self.tick == ticks:
                break
            with np.errstate(all="ignore"):  # overflow and invalid values become faults
                self._run_tick(substeps)
            self.tick += 1
            if self.tick < ticks:
                run_ticks(self._start(), ticks, substeps)
        self.steps += ticks * substeps

    def _run_tick(self, substeps: int) -> None:
        """Run the present tick, or the rest of it, and observe it."""
        executor = self._executor
        rows = self._at(self.tick)
        done = self._step
        before = self.steps + self.tick * substeps
        command = rows.command
        if done == 0:
            if self._pushes.counts:
                assert self._draws is not None
                inputs = self._faults.suspended, self._draws.episodes, substeps
                if self._pushes.push(self.pack, *inputs):
                    executor.measure()
            if self._faults.suspended.any() or not are_finite(*command):
                command = self._faults.contained(command, before + 1, executor.measured.qpos)
                self._place_failed()
        # An event may come at each sim step, the last one included.
        while True:
            if done == substeps:
                self._take_results()
            if executor.failed:
                self._contain(before + done, executor.before, executor.outputs.returned)
            if done == substeps:
                break
            done = executor.run(command, self._moves, done, substeps)
        # The executors look at positions alone, since each look at a sim step costs time.
        strays = not self.pack.spec.is_alone and self.pack.strays().any()
        if strays or not (is_near(executor.measured.qpos) and are_finite(self.pack.read_qvel())):
            self._contain(before + done, executor.measured.qpos, None)
        if self._sensed:
            self._take_means(substeps)
        self.observe(rows)

    def _take_results(self) -> None:
        for name, rows in self._executor.outputs.shown.items():
            self._shown[name][...] = False if rows is None else rows

    def _take_means(self, substeps: int) -> None:
        """Take the means of the link sensors over a tick of ``substeps`` sim steps, 0 for envs that
        failed.
        """
        for name, means in self.pack.take_sensed(substeps).items():
            shown = self._shown[name]
            shown[...] = means
            shown[self._faults.failed] = 0

    def observe(self, rows: Arrays) -> None:
        """Write observation and faults into these envs' rows."""
        observation = rows.observation
        observation.qpos[...] = self._executor.measured.qpos
        observation.qvel[...] = self.pack.read_qvel()
        for name, shown in self._shown.items():
            getattr(observation, name)[...] = shown
        if observation.base_pose is not None and observation.base_twist is not None:
            pose, twist = np.split(self.pack.read_base(), [7], axis=1)
            observation.base_pose[...] = pose
            observation.base_twist[...] = twist
        if observation.starved is not None:
            observation.starved[...] = self._executor.state("plan").starved[:, 0]
        self._faults.observe(rows)

    # -- snapshots

    def read(self) -> dict[str, Rows]:
        """Return the state of these envs, physics and controller, as arrays by name (M, ...).

        ``engine`` are robots and content, of which only the engine knows the meaning
        (:meth:`batchpid.sim.engine.protocol.EnginePack.read_state`). ``control/...`` are the states
        of stages, by their names.
        """
        control = by_name(self._executor.setup.stages, self._executor.read_state())
        tree = {"engine": self.pack.read_state(), "control": control} | self._parts()
        return flatten(tree, read=np.array)

    def _parts(self) -> Document:
        """Return the arrays outside engine and control that a snapshot holds: results of the last
        tick, episodes of the motors' noise, and the state of faults and pushes.
        """
        return self._shown | {
            "episode": self._episode,
            "containment": self._faults.state,
            "pushes": self._pushes.counts,
        }

    def snapshot(self) -> dict[str, Rows]:
        """Return the state as :meth:`read` does. It is a barrier: these envs go on as if restored
        from it.
        """
        rows = self.read()
        self._resume(rows, self._params, self._actuators, self._draws)
        return rows

    def restore(self, snapshot: Snapshot, draws: Draws) -> None:
        """Put these envs into the state of ``snapshot``, with its params and ``draws``."""
        self.steps = snapshot.steps
        self._resume(snapshot.rows, snapshot.params, snapshot.actuators, draws)
        self.observe(self._at(0))

    def _resume(
        self,
        rows: dict[str, Rows],
        params: bp.PIDParams,
        actuators: bp.Actuators | None,
        draws: Draws | None,
    ) -> None:
        """Go on from a state that :meth:`read` returned."""
        randomization = self._options.randomization
        before = self._params, self._actuators
        has_actuators = before[1] is not None or actuators is not None
        # The control stays where nothing of it can have changed, since a new one takes time.
        stays = self._controller is None and randomization is None
        stays = stays and _are_equal((params, actuators), before)
        self._params, self._actuators, self._draws = params, actuators, draws
        # The contact caches of some engines, and the order in which they solve contacts, depend on
        # the past. A new world has no past.
        varies = randomization is not None and randomization.changes_robot
        if varies or "complete_state" not in self._options.load_engine().capabilities:
            self.pack.close()
            self.pack = self._make_pack(draws)
            stays = False
        # Actuators come before the state: they say which arrays it has.
        if has_actuators and not stays:
            self._write_joints()
        # Placing robots clears efforts and suspension, so these follow.
        self.pack.write_state_rows(rows["engine"])
        for name, array in flatten(self._parts()).items():
            array[...] = rows[name]
        self.pack.suspend(self._faults.suspended)
        self.pack.write_qf(self._shown["effort"])
        if not stays:
            self._make_control(goes_on=False)
        executor = self._executor
        executor.failed = False
        executor.measure()
        stages, like = executor.setup.stages, executor.read_state()
        control = unflatten(by_name(stages, like), rows, name="control")
        pairs = zip(stages, like, strict=True)
        executor.write_state(tuple([control.get(stage.name, state) for stage, state in pairs]))

    def poses(self, names: tuple[str, ...] | None = None) -> list[Rows]:
        """Return the poses of the entities that ``build`` returned for each env, or of bodies
        ``names``, (..., 7).
        """
        return self.pack.read_poses(names)

    # -- envs that fail

    def _contain(self, step: int, before: Float64, returned: Any) -> None:
        """Suspend or reset the envs that failed in sim step ``step``, after positions ``before``
        (M, dof).

        ``returned`` is the effort of the caller's own controller, or None.
        """
        # The fault is handled here, and the tick goes on.
        self._executor.failed = False
        if returned is not None:
            params = self._executor.setup.control.params
            returned = clip(returned, params.effort_min, params.effort_max, np)
        self._faults.fail_state(self.pack, step, before, returned)
        self._place_failed()

    def _place_failed(self) -> None:
        """Place the envs that have failed since the last call: suspended, or at their start."""
        failed = self._faults.pop_unplaced()
        if failed.any():
            self._place(failed, *self._faults.places())

    def _place(self, mask: NDArray[np.bool_], qpos: Float64, qvel: Float64) -> None:
        """Place the envs of ``mask`` (M,), and restart their control."""
        pack = self.pack
        executor = self._executor
        setup = executor.setup
        rows = np.flatnonzero(mask)
        base = None if pack.spec.fixed_base else self._faults.start_base[rows]
        pack.write_state(rows.tolist(), qpos[rows], qvel[rows], base)
        pack.suspend(self._faults.suspended)
        for shown in self._shown.values():
            shown[mask] = 0
        if self._draws is not None:
            self._pushes.begin(mask, self._draws.episodes)
        executor.measure()
        if setup.control.has_motors:
            self._episode[mask] += 1
        fresh = started(setup.stages, setup.values(self._episode))
        executor.write_state(replace_envs(executor.read_state(), fresh, mask))


def _are_equal(one: Any, other: Any) -> bool:
    """Return whether two trees have the same parts, and arrays with the same values."""
    if structure(one) != structure(other):
        return False
    return all(map(np.array_equal, leaves(one), leaves(other)))
