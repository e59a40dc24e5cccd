"""Group of envs that advance together: one pack, its control, and the parts that hold their state.

An executor runs the sim steps. The group handles what happens between them: a possible failure, a
command that is not finite, a push, the sensors of links, a reset, new params or actuators.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64, Rows
from batchpid.arrays.elementwise import clip
from batchpid.arrays.trees import flatten, leaves, structure, unflatten
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.loop.array_executors import JAXExecutor, NumPyExecutor
from batchpid.sim.loop.arrays import Arrays
from batchpid.sim.loop.env_parts import ActingDraws, LinkSensors, OwnController, Pushes, variation
from batchpid.sim.loop.faults import FaultContainment, are_finite, is_near
from batchpid.sim.loop.group_control import GroupControl
from batchpid.sim.loop.native_executor import NativeExecutor, run_ticks, runs_natively
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import Draws
from batchpid.stages.stage import States, adopted, by_name, placed, started
from batchpid.stages.values import Command, Measured, Values


class EnvGroup:
    """One pack and its control; runs the sim steps of ticks, and suspends or resets envs that fail.

    ``envs`` are its rows in the loop's arrays, ``params`` the params of these envs, and ``arrays``
    their input and output. ``controller`` is the caller's own, or None.
    """

    def __init__(
        self,
        pack: EnginePack,
        envs: slice,
        params: bp.PIDParams,
        options: RunnerOptions,
        controller: OwnController | None,
        arrays: Arrays,
    ) -> None:
        self.pack = pack
        self.envs = envs
        self.tick = 0
        """First tick of the run that is not complete."""
        self._step = 0  # sim steps of it that are done
        self._steps = 0  # sim steps before the run
        self._moves = False  # whether the run gives rates of setpoints
        self._runs_whole = False  # whether the native code runs whole ticks
        self._options = options
        self._controller = controller
        self._arrays = arrays
        self._at = cache(arrays.at)  # views at a tick
        self.acting = ActingDraws(options, params)
        self._faults = FaultContainment(pack.size, pack.dof, options.on_fault)
        self._sensors = LinkSensors(options, pack.size)
        self._pushes = Pushes(options, pack.size)
        self._episode = np.zeros(pack.size, np.int64)
        # Results of the last sim step, which outlive executors: native code writes them in each tick.
        shape = (pack.size, pack.dof)
        self._last: dict[str, Rows] = {
            "effort": np.zeros(shape, np.float32),
            "saturated": np.zeros(shape, bool),
            "guarded": np.zeros(shape, bool),
        }
        reads_base = "base_state" in options.load_engine().capabilities and pack.spec.mjcf is None
        is_read = pack.spec.is_alone or (reads_base and not pack.spec.fixed_base)
        has_parts = bool(self._sensors.values or self._pushes.counts)
        self._observes_natively = is_read and not has_parts
        setup = self._setup()
        self._prepare(setup, started(setup.stages, self._values(setup)))

    def _setup(self) -> GroupControl:
        """Return the control of the present robots, params and actuators."""
        acting = self.acting
        inputs = acting.acting_params, acting.acting_actuators, self._controller
        return GroupControl.of(self._options, self.pack, *inputs)

    def _values(self, setup: GroupControl) -> Values:
        """Return the values in which stages start, at the present state of the robots."""
        pack, control = self.pack, setup.control
        passive = None
        if control.gravity:
            passive = pack.passive_force(True, control.coriolis)
        measured = Measured(pack.read_qpos(), pack.read_qvel(), passive)
        model = setup.model._replace(episode=self._episode)
        return Values(Command(None), measured, measured, control.timestep, model=model)

    def _adopt(self) -> None:
        """Make the stages of the present robots, params and actuators, which go on from the states
        so far.
        """
        executor = self._executor
        stages = executor.setup.stages
        pairs = zip(stages, executor.read_state(), strict=True)
        before = {stage.name: (stage, state) for stage, state in pairs}
        setup = self._setup()
        self._prepare(setup, adopted(setup.stages, before, self._values(setup)))

    def _prepare(self, setup: GroupControl, states: States) -> None:
        """Make the executor, which goes on from the states, and set the engine's drives."""
        # Native wherever the engine has native steps, under backend "numpy" too: the bits are the
        # same.
        self._executor: NumPyExecutor | NativeExecutor
        if self._options.backend == "jax":
            self._executor = JAXExecutor(setup, states)
        elif self.pack.steps_natively and runs_natively(setup):
            self._executor = NativeExecutor(
                setup, states, self._arrays, self._last, self._faults.rows
            )
        else:
            self._executor = NumPyExecutor(setup, states)
        if self._options.control == "drive":
            damping, stiffness = setup.control.drive
            limit = self.acting.acting_params.effort_max
            if limit is None:
                limit = np.full_like(stiffness, np.inf)
            self.pack.write_drive(stiffness, damping, limit)

    # -- changes between ticks

    def set_params(self, params: bp.PIDParams) -> None:
        """Change gains, limits and times in flight; the controller's state carries on."""
        self.acting.set_params(params)
        self._adopt()

    def set_actuators(self, actuators: bp.Actuators | None) -> None:
        """Change the actuators in flight; their state carries on."""
        if actuators is not None or self.acting.actuators is not None:
            self._put_actuators(actuators)
            self._adopt()

    def add_chunk(self, chunk: Float64, latency: Float64) -> None:
        """Add a chunk (M, rows, dof) that is ``latency`` (M,) [s] old to the plan."""
        self._executor.change("plan", lambda stage, state: stage.add(state, chunk, latency))

    def _put_actuators(self, actuators: bp.Actuators | None, rows: list[int] | None = None) -> None:
        """Put actuators into effect, for the robots ``rows`` or all."""
        had_motors = self.acting.has_motors
        # Friction and armature behind the gear belong to the engine's joints.
        self.pack.write_joints(self.acting.set_actuators(actuators), rows)
        # New motors begin the streams of their noise again.
        if self.acting.has_motors and not had_motors:
            self._episode[:] = 0

    def reset(
        self,
        mask: NDArray[np.bool_],
        qpos: Float64,
        qvel: Float64,
        steps: int,
        base: Float64 | None = None,
    ) -> None:
        """Place the envs of ``mask`` (M,), with a fresh controller state, after ``steps`` sim
        steps.

        Floating bases are placed at ``base`` (M, 13).

        An env whose ``qpos`` or ``qvel`` (M, dof) is not finite returns to its last start, and has
        failed.
        """
        if not mask.any():  # a reset of other envs
            return
        faults = self._faults
        faults.clear(mask)
        self._vary(mask)
        bad = {
            cause: mask[:, None] & ~np.isfinite(rows)
            for cause, rows in (("qpos", qpos), ("qvel", qvel))
        }
        # An env with a start that is not finite keeps its last one, and fails there.
        good = mask & ~(bad["qpos"] | bad["qvel"]).any(1)
        faults.start_qpos[good], faults.start_qvel[good] = qpos[good], qvel[good]
        if base is not None:
            faults.start_base[good] = base[good]
        self._place(mask, faults.start_qpos, faults.start_qvel)
        self._sensors.clear(mask)
        for cause, entries in bad.items():
            faults.fail(entries, cause, steps, faults.start_qpos)
        self._place_failed()

    def _vary(self, mask: NDArray[np.bool_]) -> None:
        """Put the draws of the envs of ``mask`` (M,) into effect, before these envs are placed."""
        randomization = self._options.randomization
        acting = self.acting
        if randomization is None or acting.draws is None:
            return
        rows = np.flatnonzero(mask).tolist()
        # The robots first: friction and inertia of the motors add to theirs.
        if randomization.changes_robot:
            self.pack.vary(rows, variation(self._options, len(rows), acting.draws.for_envs(rows)))
        self._put_actuators(acting.actuators, rows)
        acting.set_params(acting.params)
        self._adopt()

    # -- ticks

    def start(self, moves: bool, steps: int) -> list[NativeExecutor]:
        """Start a run after ``steps`` sim steps, at tick 0; return the executor if native code runs
        whole ticks.

        ``moves`` says whether the commands give rates of setpoints.
        """
        self.tick, self._steps = 0, steps
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
        if not (is_quiet and self._observes_natively and executor.runs_whole_ticks):
            return []
        self._runs_whole = True
        executor.start(self._moves, 0, self.tick)
        return [executor]

    def finish(self, ticks: int, substeps: int) -> None:
        """Run the rest of ``ticks`` of ``substeps`` sim steps, after the common native call for
        whole ticks.
        """
        while True:
            if self._runs_whole:
                self._complete()
            if self.tick == ticks:
                return
            with np.errstate(all="ignore"):  # overflow and invalid values become faults
                self._run_tick(substeps)
            self.tick += 1
            if self.tick < ticks:
                run_ticks(self._start(), ticks, substeps)

    def _complete(self) -> None:
        """Complete the ticks of a native call: they are observed, up to an event within a tick."""
        assert isinstance(self._executor, NativeExecutor)
        self._runs_whole = False
        self.tick, self._step = self._executor.complete()

    def _run_tick(self, substeps: int) -> None:
        """Run the present tick, or the rest of it, and observe it."""
        executor = self._executor
        rows = self._at(self.tick)
        done = self._step
        before = self._steps + self.tick * substeps
        command = rows.command
        if done == 0:
            self._push(substeps)
            self._sensors.begin(self.pack)
            if self._faults.suspended.any() or not are_finite(*command):
                command = self._without_faults(command, before + 1)
        # An event may come at each sim step, the last one included.
        while True:
            if done == substeps:
                self._take_results()
            if executor.failed:
                self._contain(before + done, executor.before, executor.results().returned)
            if done == substeps:
                break
            done = executor.run(command, self._moves, done, substeps)
        # The executors look at positions alone, since each look at a sim step costs time.
        strays = not self.pack.spec.is_alone and self.pack.strays().any()
        if strays or not (is_near(executor.qpos()) and are_finite(self.pack.read_qvel())):
            self._contain(before + done, executor.qpos(), None)
        self._sensors.end(self.pack, substeps, self._faults.failed)
        self.observe(rows)

    def _take_results(self) -> None:
        outputs = self._executor.results()
        results = outputs.motor, outputs.saturated, outputs.guarded
        for last, rows in zip(self._last.values(), results, strict=True):
            last[...] = False if rows is None else rows

    def _push(self, substeps: int) -> None:
        """Push the bases that are due before a tick of ``substeps`` sim steps."""
        pushes, draws = self._pushes, self.acting.draws
        if not pushes.counts:
            return
        assert draws is not None
        rows, twists = pushes.due(self._faults.suspended, draws.episodes)
        if rows:
            self.pack.push(rows, twists)
            self._executor.measure()
        pushes.counts["steps"] += substeps

    def observe(self, rows: Arrays) -> None:
        """Write observation and faults into these envs' rows."""
        observation = rows.observation
        observation.qpos[...] = self._executor.qpos()
        observation.qvel[...] = self.pack.read_qvel()
        for name, last in self._last.items():
            getattr(observation, name)[...] = last
        if observation.base_pose is not None and observation.base_twist is not None:
            pose, twist = np.split(self.pack.read_base(), [7], axis=1)
            observation.base_pose[...] = pose
            observation.base_twist[...] = twist
        if observation.starved is not None:
            stages, states = self._executor.setup.stages, self._executor.read_state()
            observation.starved[...] = by_name(stages, states)["plan"].starved[:, 0]
        for name, values in self._sensors.values.items():
            getattr(observation, name)[...] = values
        self._faults.observe(rows)

    def observe_first(self) -> None:
        """Write observation and faults into the first tick, after a change between runs."""
        self.observe(self._at(0))

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
        sim step, episodes of the motors' noise, those of faults, sensors and pushes, and the
        digests of the user's content.
        """
        return self._last | {
            "episode": self._episode,
            "containment": self._faults.state,
            "sensors": self._sensors.values,
            "pushes": self._pushes.counts,
            "content": {"digest": self.pack.content} if self.pack.content.size else {},
        }

    def write(
        self,
        pack: EnginePack,
        rows: Mapping[str, Rows],
        params: bp.PIDParams,
        actuators: bp.Actuators | None,
        draws: Draws | None,
    ) -> None:
        """Continue with ``pack`` in a state that :meth:`read` returned, with the params, actuators
        and draws of a snapshot.
        """
        acting = self.acting
        is_custom = self._controller is not None
        # The control step stays where nothing of it can have changed, since a new one takes time.
        stays = pack is self.pack and not is_custom and self._options.randomization is None
        stays = stays and _are_equal((params, actuators), (acting.params, acting.actuators))
        self.pack = pack
        acting.draws = draws
        # Params and actuators come before the state: they say which arrays it has.
        if not stays:
            acting.set_params(params)
            if actuators is not None or acting.actuators is not None:
                self._put_actuators(actuators)
        # Placing robots clears efforts and suspension, so these follow.
        pack.write_state_rows(rows["engine"])
        for name, array in flatten(self._parts()).items():
            array[...] = rows[name]
        pack.suspend(self._faults.suspended)
        pack.write_qf(self._last["effort"])
        executor = self._executor
        if stays:
            setup, like = executor.setup, executor.read_state()
        else:
            setup = self._setup()
            like = started(setup.stages, self._values(setup))
        control = unflatten(by_name(setup.stages, like), rows, name="control")
        pairs = zip(setup.stages, like, strict=True)
        states = tuple([control.get(stage.name, state) for stage, state in pairs])
        if stays:
            executor.failed = False
            executor.measure()
            executor.write_state(states)
        else:
            self._prepare(setup, states)

    # -- envs that fail

    def _contain(self, step: int, before: Float64, returned: Any) -> None:
        """Suspend or reset the envs that failed in sim step ``step``, after positions ``before``
        (M, dof).

        ``returned`` is the effort of the caller's own controller, or None.
        """
        # The fault is handled here, and the tick goes on.
        self._executor.failed = False
        if returned is not None:
            params = self.acting.acting_params
            returned = clip(returned, params.effort_min, params.effort_max, np)
        limit = self._options.speed_limit
        self._faults.fail_state(self.pack, step, before, returned, limit)
        self._place_failed()

    def _without_faults(self, command: Command, step: int) -> Command:
        """Mark the envs with non-finite commands as failed in sim step ``step``; return commands
        with neutral values for all failed envs.
        """
        faults, options = self._faults, self._options
        for cause, rows in command._asdict().items():
            faults.fail(~np.isfinite(rows), cause, step, self._executor.qpos())
        self._place_failed()
        setpoint = self._executor.qpos() if options.sets_positions else options.command.neutral
        failed = faults.failed[:, None]
        neutral = Command(setpoint, 0.0, 0.0, 0.0)
        return Command(*map(np.where, [failed] * len(neutral), neutral, command))

    def _place_failed(self) -> None:
        """Place the envs that have failed since the last call: suspended, or at their start."""
        faults = self._faults
        failed = faults.pop_unplaced()
        if not failed.any():
            return
        qpos, qvel = faults.start_qpos, faults.start_qvel
        if faults.suspends:
            qpos = faults.suspended_qpos
            qvel = np.zeros_like(qvel)
        self._place(failed, qpos, qvel)

    def _place(self, mask: NDArray[np.bool_], qpos: Float64, qvel: Float64) -> None:
        """Place the envs of ``mask`` (M,), and restart their control."""
        pack = self.pack
        acting = self.acting
        executor = self._executor
        setup = executor.setup
        rows = np.flatnonzero(mask)
        base = None if pack.spec.fixed_base else self._faults.start_base[rows]
        pack.write_state(rows.tolist(), qpos[rows], qvel[rows], base)
        pack.suspend(self._faults.suspended)
        for last in self._last.values():
            last[mask] = 0
        if acting.draws is not None:
            self._pushes.begin(mask, acting.draws.episodes)
        executor.measure()
        if acting.has_motors:
            self._episode[mask] += 1
        states = placed(setup.stages, executor.read_state(), self._values(setup), mask)
        executor.write_state(states)


def _are_equal(one: Any, other: Any) -> bool:
    """Return whether two trees have the same parts, and arrays with the same values."""
    if structure(one) != structure(other):
        return False
    return all(map(np.array_equal, leaves(one), leaves(other)))
