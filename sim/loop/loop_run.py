"""Long runs of a closed loop: in native code where programs are used, with lanes of rigid trees in
place of an engine, else step by step in NumPy.
"""

from __future__ import annotations

import ctypes
from types import SimpleNamespace
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64, Rows
from batchpid.arrays.trees import mapped
from batchpid.sim.engine import native
from batchpid.sim.engine.native import WIDTH, structure
from batchpid.sim.engine.native_model import NativeModel, aligned, table
from batchpid.sim.loop.closed_loop import ClosedLoop, LoopState
from batchpid.sim.loop.group_control import GroupControl, model_functions
from batchpid.sim.loop.native_executor import TickProgram
from batchpid.sim.loop.tree_plant import IMPEDANCE
from batchpid.stages import stages_of
from batchpid.stages.stage import by_name, started
from batchpid.stages.values import Command, Measured, Model, Step, Values


class LoopRun:
    """Run of a closed loop from ``qpos`` and ``qvel`` (envs, dof) on, up to ``steps`` sim steps at
    a time.

    Its plant is a :class:`.TreePlant`. ``setpoint`` (envs, dof) is that at the start.

    Attributes
    ----------
    setpoints
        Setpoints or efforts of the next sim steps (steps, envs, dof), for the caller to fill in.
    qpos, qvel
        Positions and velocities after each sim step (steps, envs, dof).
    measured
        Reading before the first sim step.
    states
        States of the stages by name, whose arrays may be changed before the first sim step.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        qpos: Float64,
        qvel: Float64,
        setpoint: Float64,
        steps: int,
    ) -> None:
        self._loop = loop
        self.setpoints, self.qpos, self.qvel = np.zeros((3, steps, *qpos.shape))
        self._plant = loop.plant.init(qpos, qvel)
        stages = stages_of(loop.control)
        command = Command(np.array(setpoint), feedforward=np.zeros_like(setpoint))
        lanes = None
        if not native.obstacle() and loop.control.coupling.is_identity:
            lanes = Lanes(loop, qpos, qvel)
            values = lanes.values(command)
        else:
            values = loop.values(self._plant, command, Step(0, 1), np.zeros(len(qpos), int))
        self.measured = values.measured
        states: Any = mapped(lambda leaf: np.array(leaf, order="C"), started(stages, values))
        self._states = states
        self.states = by_name(stages, states)
        self._program = None
        if lanes is not None:
            setup: Any = GroupControl(None, lanes, loop.control, stages, values.model)  # type: ignore[arg-type]
            values = values._replace(model=Model(), step=Step(0, 1, np.zeros(())))
            self._program = TickProgram(
                setup,
                states,
                values,
                np.zeros_like(qpos),
                self._copies,
                False,
            )
            lanes.prepare(self._program)

    def run(self, steps: int) -> None:
        """Run sim steps, at most as many as the tables have."""
        program = self._program
        if program is not None:
            program.tick.tick = program.tick.step = 0
            native.extension("_gateway").ticks((program.bound,), steps, 1, True)
            if program.tick.tick != steps:
                raise RuntimeError("a setpoint is not finite")
            return
        episode = np.zeros(self.setpoints.shape[1], int)
        state = LoopState(self._plant, self._states, episode)
        for at in range(steps):
            state, seen = self._loop.step(state, self.setpoints[at])
            self.qpos[at], self.qvel[at] = seen[:2]
        self._plant, self._states, _ = state

    def _copies(self, program: TickProgram) -> list[tuple[Rows, Rows]]:
        """Return the copies between the tables and the arrays of a sim step."""
        command, measured, *_ = program.values
        # Bytes are copied as they are, numbers of observations in single precision.
        rows = [
            (self.qpos.view(np.bool_), measured.qpos.view(np.bool_)),
            (self.qvel.view(np.bool_), measured.qvel.view(np.bool_)),
        ]
        return [(self.setpoints, command.setpoint), *rows]


class Lanes:
    """Robots of a closed loop in lanes of native code, for :class:`.TickProgram`."""

    def __init__(self, loop: ClosedLoop, qpos: Float64, qvel: Float64) -> None:
        plant: Any = loop.plant
        tree = loop.tree
        self.size, self.dof = qpos.shape
        self.force_model = NativeModel(lambda: tree)
        self.joint_model = self.force_model
        self.steps_natively = True
        self.spec = SimpleNamespace(fixed_base=True)
        self.rigid_tree = tree
        self.first_env = 0
        self.armature = np.zeros((1, self.dof))
        actuators = loop.control.actuators
        if actuators is not None and actuators.armature is not None:
            self.armature = actuators.armature
        self._control = loop.control
        self._start = qpos, qvel
        self._group = structure("Group")(robots=self.size, dof=self.dof)
        if plant.bodies.mass.ndim > 2:
            self.joint_model = NativeModel(lambda: tree, inertias=tree.inertias(plant.bodies))
        least, most, width = IMPEDANCE
        blocks = -(-self.size // WIDTH)
        arrays = {
            "bias": aligned(blocks, self.dof, WIDTH),
            "mass": aligned(blocks, self.dof * (self.dof + 1) // 2, WIDTH),
            "acceleration": aligned(blocks, self.dof, WIDTH),
            "qpos": table(qpos, self.size),
            "qvel": table(qvel, self.size),
            "armature": table(plant.inertia, self.size),
            "weight": table(plant.weight[None], self.size),
            "gravity": table(plant.bodies.gravity[None], self.size),
            "low": plant.low,
            "high": plant.high,
        }
        free = structure("FreeMotion")(
            model=self.joint_model.address,
            stiffness=(most * 2 * plant.timestep) ** -2.0,
            rate_gain=2.0 / (most * 2 * plant.timestep),
            least=least,
            most=most,
            width=width,
            timestep=plant.timestep,
            robots=self.size,
            **{name: array.ctypes.data for name, array in arrays.items()},
        )
        self._group.lanes = ctypes.addressof(free)
        self._kept = arrays, free

    def passive_force(self, gravity: bool, coriolis: bool) -> Float64:
        """Return parts of the passive force at the start (envs, dof)."""
        return self.force_model.passive_force(*self._start, gravity, coriolis)

    def read_base_motion(self) -> None:
        """Return None: the base is fixed."""

    def values(self, command: Command) -> Values:
        """Return the values of the first sim step before its stages."""
        pack: Any = self
        control = self._control
        qpos, qvel = self._start
        passive = self.passive_force(control.gravity, control.coriolis)
        measured = Measured(qpos.copy(), qvel.copy(), passive)
        model = model_functions(pack, control)
        return Values(command, measured, measured, control.timestep, model=model)

    def prepare(self, program: TickProgram) -> None:
        """Let a program step these robots."""
        program.tick.group = ctypes.addressof(self._group)
        program.tick.drawn = -1
