"""Pack of robots in MuJoCo. They share a model where they do not differ, and nothing else.

Longer than 350 lines because that is the whole interface between loop and engine.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from batchpid.arrays.array_types import Bool, Float64, MjData, Rows
from batchpid.motors import Actuators
from batchpid.sim.description.tables import CONTACT_FRICTION
from batchpid.sim.engine.mujoco.file_scene import check_links
from batchpid.sim.engine.mujoco.free_motion import FreeMotions, place_of_contacts
from batchpid.sim.engine.mujoco.model_builder import (
    FLOATING,
    LARGEST_FORCE,
    robot_model,
    set_inertia,
)
from batchpid.sim.engine.mujoco.mujoco_sensors import MujocoLinkSensors, wrench_tables
from batchpid.sim.engine.mujoco.mujoco_step import STATE, DataPool, MujocoStep, obstacle, rest
from batchpid.sim.engine.native import FARTHEST
from batchpid.sim.engine.protocol import BASE_AT_REST, Engine, EnginePack
from batchpid.sim.engine.scene_spec import SOLVERS, SceneSpec, Variation
from batchpid.task_space.frames import matrix_of, rotate, unrotate

_KEPT_STATE = STATE & ~int(mujoco.mjtState.mjSTATE_CTRL)
"""Parts of the state in snapshots: all but the targets of drives, which every tick writes."""
_LEAST_FRICTION = 1e-5
"""Smallest coefficient of friction in MuJoCo."""
_JOINTS = ("dof_armature", "dof_damping", "actuator_biasprm", "actuator_forcerange")
"""Fields of ``mujoco.MjModel`` that joints and drives change."""


class MujocoPack(EnginePack):
    """Pack of robots in MuJoCo."""

    def __init__(
        self,
        spec: SceneSpec,
        size: int,
        first_env: int = 0,
        variation: Variation | None = None,
        workspace: dict[object, DataPool] | None = None,
    ) -> None:
        super().__init__(spec, size, first_env, variation, not obstacle())
        varied = self._variation
        self._worlds_vary = varied.ground_friction is not None or varied.gravity is not None
        self.qf = np.zeros((size, self.dof))
        if spec.mjcf is None:  # else MuJoCo has the file's equalities
            reads = self.spec.fixed_base and self.steps_read_force(True, True)
            self._couple(np.zeros(self.dof, bool), None if reads else self.joint_model)
        else:
            links = *(spec.contacts or ()), *(spec.wrenches or ()), spec.carrier
            check_links(spec, spec.mjcf, filter(None, links))
        self._stiffness = self._rate_gain = np.zeros((1, self.dof))
        self._robot = robot = robot_model(spec)
        if workspace is None:
            workspace = {}
        if robot not in workspace:
            workspace[robot] = DataPool(robot)
        self._pool = workspace[robot]
        self._sensors = MujocoLinkSensors(self.spec, robot.model, robot.bodies)
        self._sensed = np.zeros((self.size, self._sensors.size))
        self.models, self.rows = [self._pool.model] * self.size, self._pool.initial(self.size)
        self._at, self._moves = robot.qpos, robot.qvel
        self._free: FreeMotions | None = None
        # A robot that touches nothing is then a tree of rigid bodies, under efforts alone.
        is_tree = spec.fixed_base and spec.mjcf is None and self.dof > 0
        if self.steps_natively and is_tree and place_of_contacts() is not None:
            self._free = FreeMotions(robot, self.joint_model, self._sensed)
        self._change_world(range(self.size))
        self._change_masses(range(self.size))
        self._update(range(self.size))
        if variation is not None:
            self.write_joints(None)

    @property
    def data(self) -> list[MjData]:
        """``mujoco.MjData`` of each robot, in its state."""
        if self._free is None:
            return self._pool.take(self.models, self.rows)
        data = self._pool.lend(self._free)
        for row, (model, robot_data) in enumerate(zip(self.models, data, strict=True)):
            self._free.show(row, model, robot_data)
        return data

    def _update(self, rows: Iterable[int]) -> None:
        """Compute all that follows from the states of robots ``rows``, after a change of models."""
        if self._free is None:
            self._evaluate(rows)
        else:
            wrenches = {}
            if self.spec.wrenches:
                wrenches = wrench_tables(self.spec, self._masses.added, self.size)
            self._free.use(self.models, wrenches)
        self.calls = object()
        self._own_step: MujocoStep | None = None

    def _evaluate(self, rows: Iterable[int]) -> None:
        """Compute all that follows from the states of robots ``rows``."""
        data = self.data
        with _without_warnings():
            for row in rows:
                mujoco.mj_step1(self.models[row], data[row])

    def _own_model(self, row: int) -> Any:
        """Return the model of robot ``row`` alone, which may be changed."""
        model = self.models[row]
        if model is self._pool.model or self.models.count(model) > 1:
            model = self.models[row] = copy.copy(model)
        return model

    # -- reading
    # ----------------------------------------------------------------------------------------------

    def read_qpos(self) -> Float64:
        if self._free is not None:
            return self._free.read(0)
        return np.array([data.qpos[self._at] for data in self.data])

    def read_qvel(self) -> Float64:
        if self._free is not None:
            return self._free.read(1)
        return np.array([data.qvel[self._moves] for data in self.data])

    def passive_force(self, gravity: bool, coriolis: bool) -> Float64:
        if self._free is None and self.steps_read_force(gravity, coriolis):
            return np.array([data.qfrc_bias[self._moves] for data in self.data])
        return self._force(self.force_model, gravity, coriolis)

    # -- stepping
    # ----------------------------------------------------------------------------------------------

    def write_qf(self, effort: Rows) -> None:
        self.qf[...] = effort

    def step(self) -> None:
        """Do one sim step of every robot, with constraint efforts on coupled joints."""
        if self.steps_natively:
            if self._own_step is None:
                self._own_step = self.compiled_step(False, False)
            self._own_step.may_have_failed(self._own_step(self.qf, *np.empty((3, *self.qf.shape))))
            return
        effort = self.qf
        if self._constraint is not None:
            effort = self._constraint.apply(self.qf, self.read_qpos(), self.read_qvel())
        with _without_warnings():
            everyone = self.data
            for row in np.flatnonzero(~self._suspended):
                model = self.models[row]
                data = everyone[row]
                data.qfrc_applied[self._moves] = effort[row]
                mujoco.mj_step2(model, data)
                self._sensed[row] += data.sensordata
                if (np.abs(data.qpos[self._at]) <= FARTHEST).all():
                    mujoco.mj_step1(model, data)

    def steps_read_force(self, gravity: bool, coriolis: bool) -> bool:
        return gravity and coriolis and self._is_model

    def compiled_step(self, gravity: bool, coriolis: bool, drives: bool = False) -> MujocoStep:
        arrays = {"qf": self.qf, "sensed": self._sensed}
        if drives:
            arrays |= {"stiffness": self._stiffness, "rate_gain": self._rate_gain}
        reads_force = gravity and coriolis
        return MujocoStep(
            self._pool,
            self.models,
            self.rows,
            reads_force,
            arrays,
            self._suspended,
            self._constraint_address,
            self._free,
        )

    def _bias(self) -> Float64:
        if self.spec.fixed_base and self.steps_read_force(True, True):
            return self.passive_force(True, True)
        return self._force(self.joint_model, True, True)

    # -- changes
    # ----------------------------------------------------------------------------------------------

    def read_base(self) -> Float64:
        rows = self._bases()
        # MuJoCo's angular velocities are in the body's axes.
        rows[:, 10:] = rotate(matrix_of(rows[:, 3:7]), rows[:, 10:])
        return rows

    def _bases(self) -> Float64:
        """Return pose and velocities of the bodies of floating bases (M, 13), angular ones in the
        body's axes.
        """
        qpos, qvel = self._robot.base
        parts = slice(qpos, qpos + FLOATING + 1), slice(qvel, qvel + FLOATING)
        return np.array(
            [np.concatenate([data.qpos[parts[0]], data.qvel[parts[1]]]) for data in self.data]
        )

    def strays(self) -> Bool:
        """Return the robots (M,) whose base, or an object of the file, is beyond FARTHEST or not
        finite.
        """
        if self._robot.model.nq == self.dof:
            return np.zeros(self.size, bool)
        return ~np.array([np.abs(data.qpos).max() <= FARTHEST for data in self.data])

    def take_sensed(self, steps: int) -> dict[str, Rows]:
        means = self._sensors.quantities(self._sensed / steps)
        self._sensed[...] = 0.0
        return means

    def read_base_motion(self) -> Float64 | None:
        if self.spec.fixed_base:
            return None
        rows = self._bases()
        gravity = unrotate(matrix_of(rows[:, 3:7]), np.array(self.spec.gravity))
        return np.hstack([gravity, rows[:, 10:]])

    def push(self, rows: Sequence[int], twists: Float64) -> None:
        data = self.data
        turns = matrix_of(self._bases()[rows, 3:7])
        _, at = self._robot.base
        for row, twist, turn in zip(rows, twists, turns, strict=True):
            # MuJoCo's angular velocities are in the body's axes.
            data[row].qvel[at : at + FLOATING] += [*twist[:3], *(turn.T @ twist[3:])]
        self._evaluate(rows)

    def write_state(
        self,
        rows: Sequence[int],
        qpos: Rows,
        qvel: Rows,
        base: Float64 | None = None,
    ) -> None:
        """Place robots ``rows``: positions and velocities (len(rows), dof), zero efforts, the root
        at ``base``.
        """
        self.qf[[*rows]] = 0.0
        self._sensed[[*rows]] = 0.0
        if self._free is None:
            self._place(rows, qpos, qvel, base)
        else:
            self._free.write(rows, qpos, qvel, 0.0)
            self._free.time[[*rows]] = 0.0
        self.update_constraint(list(rows))  # within a tick, the robots may have failed

    def _place(
        self,
        rows: Sequence[int],
        qpos: Rows,
        qvel: Rows,
        base: Float64 | None,
    ) -> None:
        """Write the states of robots ``rows`` to their data."""
        everyone = self._pool.take(self.models, self.rows, rows)
        bases = np.tile(BASE_AT_REST, (len(rows), 1)) if base is None else base.copy()
        at, moves = self._robot.base
        # MuJoCo's angular velocities are in the body's axes.
        bases[:, 10:] = unrotate(matrix_of(bases[:, 3:7]), bases[:, 10:])
        for row, root, position, velocity in zip(rows, bases, qpos, qvel, strict=True):
            data = everyone[row]
            # Everything else of the scene returns to its start, but drives keep their targets.
            ctrl = data.ctrl.copy()
            rest(self.models[row], data)
            if not self.spec.fixed_base:
                data.qpos[at : at + FLOATING + 1], data.qvel[moves : moves + FLOATING] = np.split(
                    root, [FLOATING + 1]
                )
            data.qpos[self._robot.qpos] = position
            data.qvel[self._robot.qvel] = velocity
            data.ctrl[:] = ctrl
        self._evaluate(rows)

    def suspend(self, mask: Bool) -> None:
        """Leave the robots of ``mask`` (M,) where they are, and step the others."""
        self._suspended[...] = mask

    def write_joints(self, actuators: Actuators | None, rows: Sequence[int] | None = None) -> None:
        armature, damping = self._robot.terms
        values = {"dof_armature": np.maximum(armature + self._add_joints(actuators), 0.0)}
        if self.spec.mjcf is not None and self._variation.damping is not None:
            values["dof_damping"] = np.maximum(damping + self._variation.damping, 0.0)
        everyone = range(self.size)
        for row in self._set(everyone if rows is None else rows, self._moves, values):
            mujoco.mj_setConst(self.models[row], self._scratch)
        self._share()

    def _set(
        self,
        rows: Iterable[int],
        at: slice | Rows,
        values: Mapping[str, Rows],
    ) -> list[int]:
        """Set the entries ``at`` of fields of the models of robots ``rows`` to ``values`` (M | 1,
        entries, ...); return the robots whose models changed.
        """
        changed = []
        for row in rows:
            present = {name: table[row % len(table)] for name, table in values.items()}
            model = self.models[row]
            # A copy only where they differ: a model takes much memory.
            if all(np.array_equal(getattr(model, name)[at], new) for name, new in present.items()):
                continue
            model = self._own_model(row)
            for name, new in present.items():
                getattr(model, name)[at] = new
            changed.append(row)
        return changed

    def _share(self) -> None:
        """Return to one shared model if neither masses nor worlds nor armature nor drives of the
        robots differ.
        """
        first = self.models[0]
        if (
            not self._masses.added
            and not self._worlds_vary
            and all(
                np.array_equal(getattr(first, field), getattr(model, field))
                for model in self.models[1:]
                for field in _JOINTS
            )
        ):
            self.models = [first] * self.size
        self._update(range(self.size))

    @cached_property
    def _scratch(self) -> Any:
        """Data that MuJoCo's functions on models overwrite."""
        return mujoco.MjData(self._robot.model)

    def vary(self, rows: Sequence[int], variation: Variation) -> None:
        """Change the robots ``rows`` to ``variation``, one row for each of them."""
        self._change(rows, variation)
        self._change_world(rows)
        self._change_masses(rows)
        self._update(rows)

    def _change_world(self, rows: Iterable[int]) -> None:
        """Set the gravity and friction that the scenes of robots ``rows`` have."""
        gravity = self._variation.gravity
        friction = self._variation.ground_friction
        for row in rows if self._worlds_vary else ():
            model = self._own_model(row)
            if gravity is not None:
                model.opt.gravity[:] = gravity[row]
            if friction is not None:
                shapes, pairs, nominal = self._rubbing
                share = friction[row] / max(nominal, _LEAST_FRICTION)
                base = self._robot.model
                model.geom_friction[shapes, 0] = share * base.geom_friction[shapes, 0]
                model.pair_friction[pairs, :2] = share * base.pair_friction[pairs, :2]

    @cached_property
    def _rubbing(self) -> tuple[Any, Any, float]:
        """Masks of the shapes of robot and ground, and of the pairs of these, and the friction of
        the ground.
        """
        robot, file = self._robot, self.spec.mjcf
        model = robot.model
        if file is None:
            return slice(None), slice(None), CONTACT_FRICTION
        bodies = {
            *robot.bodies.values(),
            *(body for frame in robot.frames.values() for body in frame.welded),
        } - {0}
        is_ground = (model.geom_bodyid == 0) & (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
        shapes = np.isin(model.geom_bodyid, [*bodies]) | is_ground
        return shapes, shapes[model.pair_geom1] & shapes[model.pair_geom2], file.friction

    def _change_masses(self, rows: Sequence[int]) -> None:
        if not self._masses.added:
            return
        for row in rows:
            model = self._own_model(row)
            for name, inertia in self._masses.of_robot(row).items():
                set_inertia(model, self._robot, name, inertia)
            mujoco.mj_setConst(model, self._scratch)
        self._change_model(rows)

    def write_drive(self, stiffness: Rows, damping: Rows, force_limit: Rows) -> None:
        """Set the drive of every joint, of a spec with drives; each argument broadcasts to (M,
        dof).

        They are MuJoCo's actuators, implicit in the time step dt as PhysX's are: with the velocity
        v+ after it, the effort kp (r - q - dt v+) + kd (r' - v+) is a drive's with stiffness kp and
        implicit damping kd + dt kp.
        """
        limit = np.broadcast_to(np.minimum(force_limit, LARGEST_FORCE), self.qf.shape)
        self._stiffness, self._rate_gain = (
            np.broadcast_to(table, self.qf.shape).copy() for table in (stiffness, damping)
        )
        bias = np.zeros((*self.qf.shape, mujoco.mjNBIAS))
        bias[..., 1] = -self._stiffness
        bias[..., 2] = -self._rate_gain - self.spec.timestep * self._stiffness
        values = {
            "actuator_biasprm": bias,
            "actuator_forcerange": np.stack([-limit, limit], axis=2),
        }
        self._set(range(self.size), slice(None), values)
        self._update(range(self.size))

    def write_drive_target(self, position: Rows, velocity: Rows | None = None) -> None:
        rate = 0.0 if velocity is None else velocity
        values = self._stiffness * position + self._rate_gain * rate
        if self._free is not None:
            self._free.ctrl[...] = values
            return
        for data, row in zip(self.data, values, strict=True):
            data.ctrl[:] = row

    # -- snapshots
    # ---------------------------------------------------------------------------------------------

    def read_state(self) -> Float64:
        """Return the state of each robot (M, values), in MuJoCo's order."""
        states = np.empty((self.size, mujoco.mj_stateSize(self._robot.model, _KEPT_STATE)))
        for model, data, qf, state in zip(self.models, self.data, self.qf, states, strict=True):
            if self._free is not None:
                data.qfrc_applied[self._moves] = qf
            mujoco.mj_getState(model, data, state, _KEPT_STATE)
        return states

    def write_state_rows(self, states: Float64) -> None:
        for row, (model, data, state) in enumerate(
            zip(self.models, self.data, states, strict=True)
        ):
            mujoco.mj_setState(model, data, state, _KEPT_STATE)
            if self._free is not None:
                self._free.load(row, data)
        if self._free is None:
            self._update(range(self.size))

    def read_poses(self, names: Sequence[str] | None = None) -> list[Rows]:
        """Return the poses of bodies of the file, by name, in each env (names, 7)."""
        numbers = [self._robot.model.body(name).id for name in names or ()]
        return [np.hstack([data.xpos[numbers], data.xquat[numbers]]) for data in self.data]

    def close(self) -> None:
        self._pool.leave(self.rows if self._free is None else self._free)
        self.models = []


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Silence MuJoCo's warnings of states that are not finite: the loop finds and reports them."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


ENGINE = Engine(
    name="mujoco",
    title="MuJoCo",
    capabilities=frozenset({"base_state", "complete_state", "wrenches"}),
    physics=SOLVERS,
    group_size=64,
    make_pack=MujocoPack,
    native_obstacle=obstacle,
)
