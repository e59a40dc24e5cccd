"""Pack of robots in MuJoCo: one ``mujoco.batch.Batch``, whose simulations share the model and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.elementwise import TURN
from batchpid.checks.single_owner import SingleOwner
from batchpid.motors import Actuators
from batchpid.sim.engine.coupled_joints import ConstraintEfforts
from batchpid.sim.engine.joint_friction import added_friction, own_friction
from batchpid.sim.engine.mujoco.batch_model import FLOATING, INERTIAL, BatchModel, expand_inertias, set_inertia
from batchpid.sim.engine.mujoco.model_builder import LARGEST_FORCE, RobotMj, robot_model
from batchpid.sim.engine.sapien.body_inertias import varied_bodies, varied_inertia
from batchpid.sim.engine.scene_spec import SceneSpec, Variation
from batchpid.sim.robot.mimics import coupling_of

Float64 = NDArray[np.float64]

_STAGE = mujoco.mjtStage.mjSTAGE_VEL
"""Stage up to which a sim step computes the new state: everything that does not depend on the next efforts."""
_STATE = ("qpos", "qvel", "qacc_warmstart")
"""Fields of MuJoCo's state that a robot's later motion depends on, besides its efforts."""


class MujocoPack(SingleOwner):
    """M robots of ``spec``. Arrays are (M, dof), in the order of ``spec.joints``, SI units.

    ``variation`` holds their differences from the model, one row for each; ``carrier`` is the link of the URDF that
    carries the payload, ``links`` are those whose mass or center varies. The members are those of
    :class:`batchpid.sim.engine.protocol.EnginePack`.
    """

    def __init__(
        self,
        spec: SceneSpec,
        size: int,
        first_env: int = 0,
        variation: Variation | None = None,
        carrier: str = "",
        links: Sequence[str] = (),
    ) -> None:
        self.spec, self.size, self.first_env = spec, size, first_env
        self.dof, self._variation = len(spec.joints), variation or Variation()
        varied = self._variation
        self._masses_vary = any(each is not None for each in (varied.payload, varied.link_mass, varied.center_of_mass))
        varies_links = varied.link_mass is not None or varied.center_of_mass is not None
        self._bodies = varied_bodies(spec, carrier, links if varies_links else []) if self._masses_vary else {}
        self.qf = np.zeros((size, self.dof))
        self._suspended: NDArray[np.bool_] = np.zeros(size, bool)
        self.friction = own_friction(spec, self._variation)
        self.armature = self._motors = np.zeros((1, self.dof)) if varied.armature is None else varied.armature
        self._implicit = spec.timestep * np.array([[joint.damping for joint in spec.joints]])
        coupling = coupling_of(spec.joints)
        self._continuous = np.array([joint.continuous for joint in spec.joints])
        self._constraint = None
        if coupling is not None:
            self._constraint = ConstraintEfforts(coupling, self._continuous, spec.timestep)
        self._stiffness = self._rate_gain = self._target_rate = np.zeros((1, self.dof))
        self._actuators: Actuators | None = None
        self._make_batch(robot_model(spec))
        if variation is not None:
            self.write_joints(None)
        self._batch.forward(stage=_STAGE)

    def _make_batch(self, robot: RobotMj) -> None:
        """Make the simulations, of ``robot``, with their masses."""
        self._robot = robot
        self._batch = mujoco.batch.Batch(robot.model, self.size, nthread=1, persistent=True)
        self._state = [self._batch.bind(name) for name in _STATE]
        self._qpos, self._qvel, _ = self._state
        self._applied, self._bias = self._batch.bind("qfrc_applied"), self._batch.bind("qfrc_bias")
        self._at, self._moves = _columns(robot.qpos), _columns(robot.qvel)
        if self._masses_vary:
            expand_inertias(self._batch)
            self._change_masses(range(self.size))

    @cached_property
    def _model(self) -> BatchModel:
        """Dynamics of the robots as the controller knows them."""
        return BatchModel(self._robot, self.size)

    @cached_property
    def _varied_model(self) -> BatchModel:
        """Dynamics of the robots with their variation."""
        if not self._masses_vary:
            return self._model
        model = BatchModel(self._robot, self.size)
        expand_inertias(model.batch)
        for name in INERTIAL:
            model.batch.expand(name)[...] = self._batch.expand(name)
        return model

    def read_qpos(self, dtype: Any = np.float64) -> NDArray[Any]:
        """Return the joint positions [rad or m], a new array."""
        return np.array(self._qpos[:, self._at], dtype)

    def read_qvel(self, dtype: Any = np.float64) -> NDArray[Any]:
        """Return the joint velocities [rad/s or m/s], a new array."""
        return np.array(self._qvel[:, self._moves], dtype)

    def passive_force(self, gravity: bool, coriolis: bool, dtype: Any = np.float64) -> NDArray[Any]:
        """Return the efforts that cancel gravity and Coriolis and centrifugal forces [N m or N], by the model."""
        if gravity and coriolis and self.spec.fixed_base and not self._masses_vary:
            return np.array(self._bias[:, self._moves], dtype)  # which the last sim step has computed
        base = None if self.spec.fixed_base else (self._qpos[:, : FLOATING + 1], self._qvel[:, :FLOATING])
        still = None if base is None else (base[0], np.zeros_like(base[1]))
        force = np.zeros((self.size, self.dof))
        if coriolis:
            self._model.compute(self.read_qpos(), self.read_qvel(), base)
            force += self._model.joint_bias()
        if not (coriolis and gravity):
            self._model.compute(self.read_qpos(), 0.0, still)
            force += self._model.joint_bias() if gravity else -self._model.joint_bias()
        return force.astype(dtype) if gravity or coriolis else np.zeros_like(force, dtype)

    def joint_mass_matrix(self, qpos: NDArray[Any]) -> Float64:
        """Return the mass matrices that the joints show at ``qpos`` (M, dof, dof) [kg m^2 or kg]."""
        self._varied_model.compute(qpos)
        return self._varied_model.joint_mass_matrix()

    def write_qf(self, effort: NDArray[Any]) -> None:
        """Apply joint efforts [N m or N]. They persist until written again."""
        self.qf[...] = effort
        if self._constraint is None:
            self._applied[:, self._moves] = effort

    def step(self, update: bool = True) -> None:
        """Do one sim step of every robot, with constraint efforts on coupled joints.

        Without ``update`` these take the mass matrix of an earlier step.
        """
        if self._constraint is not None:
            qpos = self.read_qpos()
            if update:
                matrix = self.joint_mass_matrix(qpos) + self._implicit[:, None] * np.eye(self.dof)
                self._constraint.update(matrix, self.passive_force(True, True))
            self._applied[:, self._moves] = self._constraint.apply(self.qf, qpos, self.read_qvel())
        if self._suspended.any():
            self._applied[self._suspended] = 0.0
        self._batch.step(stage=_STAGE)

    def write_state(self, rows: Sequence[int], qpos: NDArray[Any], qvel: NDArray[Any]) -> None:
        """Place robots ``rows``: positions and velocities (len(rows), dof), zero efforts, the root at the origin."""
        placed = np.asarray(rows, int)
        for field in (*self._state, self._applied, self._batch.bind("time")):
            field[placed] = 0.0
        if not self.spec.fixed_base:
            self._qpos[placed, 3] = 1.0
        self._qpos[placed[:, None], self._robot.qpos], self._qvel[placed[:, None], self._robot.qvel] = qpos, qvel
        self.qf[placed] = 0.0
        self._batch.forward(placed, stage=_STAGE)

    def suspend(self, mask: NDArray[np.bool_]) -> None:
        """Apply zero effort and no gravity to the robots of ``mask`` (M,), and both again to the others."""
        if (mask == self._suspended).all():
            return
        self._batch.expand("opt.gravity")[...] = np.where(mask[:, None], 0.0, self.spec.gravity)
        changed = np.flatnonzero(mask != self._suspended)
        self._suspended = mask.copy()
        self._batch.forward(changed, stage=_STAGE)

    def write_joints(self, actuators: Actuators | None, rows: Sequence[int] | None = None) -> None:
        """Add friction, damping and reflected inertia of ``actuators`` to the description's, for ``rows`` or all."""
        self._actuators = actuators
        self.friction = added_friction(own_friction(self.spec, self._variation), actuators)
        added = None if actuators is None else actuators.armature
        self.armature = self._motors + (0.0 if added is None else added)
        viscous = self.friction.viscous
        self._implicit = self.armature + self.spec.timestep * (0.0 if viscous is None else viscous)
        changed = np.arange(self.size) if rows is None else np.asarray(rows, int)
        values = np.broadcast_to(self._implicit, self.qf.shape)
        self._batch.expand("dof_armature")[changed[:, None], self._robot.qvel] = values[changed]
        self._batch.set_const(changed)
        self._batch.forward(changed, stage=_STAGE)

    def write_drive(self, stiffness: NDArray[Any], damping: NDArray[Any], force_limit: NDArray[Any]) -> None:
        """Set the drive of every joint; each argument broadcasts to (M, dof).

        They are MuJoCo's actuators, implicit in the time step dt as PhysX's are: with the velocity v+ after it, the
        effort kp (r - q - dt v+) + kd (r' - v+) is that of stiffness kp and implicit damping kd + dt kp.
        """
        if self._robot.model.nu == 0:
            state, applied = self.read_state(), self._applied.copy()
            self._make_batch(robot_model(self.spec, drives=True))
            self.write_joints(self._actuators)
            self.write_state_rows(state)
            self._applied[...] = applied
            suspended, self._suspended = self._suspended, np.zeros(self.size, bool)
            self.suspend(suspended)
        limit = np.minimum(force_limit, LARGEST_FORCE)
        shape = self.qf.shape
        self._stiffness, self._rate_gain = (np.broadcast_to(table, shape).copy() for table in (stiffness, damping))
        bias, bounds = self._batch.expand("actuator_biasprm"), self._batch.expand("actuator_forcerange")
        bias[:, :, 1] = -self._stiffness
        bias[:, :, 2] = -self._rate_gain - self.spec.timestep * self._stiffness
        bounds[:, :, 0], bounds[:, :, 1] = -limit, limit

    def write_drive_target(self, position: NDArray[Any], velocity: NDArray[Any] | None = None) -> None:
        """Set the drives' targets (M, dof): position [rad or m] and velocity [rad/s or m/s]."""
        error = position - self.read_qpos()
        position = np.where(self._continuous, position - TURN * np.rint(error / TURN), position)
        if velocity is not None:
            self._target_rate = velocity
        self._batch.bind("ctrl")[...] = self._stiffness * position + self._rate_gain * self._target_rate

    def vary(self, rows: Sequence[int], variation: Variation) -> None:
        """Change the robots ``rows`` to ``variation``, one row for each of them."""
        for mine, new in zip(self._variation, variation, strict=True):
            if mine is not None:
                mine[rows] = new
        self._change_masses(rows)

    def _change_masses(self, rows: Sequence[int]) -> None:
        for row in rows:
            for name, body in self._bodies.items():
                set_inertia(self._batch, row, self._robot.bodies[name], varied_inertia(body, self._variation, row))
        self.__dict__.pop("_varied_model", None)

    def state_sizes(self) -> list[int]:
        """Return the number of values in the state of each robot."""
        return [sum(field.shape[1] for field in self._state)] * self.size

    def read_state(self) -> Float64:
        """Return the state of each robot (M, values): MuJoCo's qpos, qvel and warm start of the solver."""
        return np.hstack(self._state)

    def write_state_rows(self, states: Float64) -> None:
        """Put the robots of this new pack into the states that :meth:`read_state` returned."""
        begin = 0
        for field in self._state:
            field[...] = states[:, begin : begin + field.shape[1]]
            begin += field.shape[1]
        self._batch.forward(stage=_STAGE)

    def read_poses(self) -> list[NDArray[np.float32]]:
        """Return an empty list: there is no content in the scenes but the robots."""
        return []

    def close(self) -> None:
        """Free the robots. The pack cannot be used afterwards."""
        self._state, self._batch = [], None
        self._qpos = self._qvel = self._applied = self._bias = np.empty((0, 0))
        for name in ("_model", "_varied_model"):
            self.__dict__.pop(name, None)


def _columns(indices: NDArray[np.intp]) -> Any:
    """Return ``indices`` as a slice where they are consecutive, which NumPy reads faster."""
    if (np.diff(indices) == 1).all():
        return slice(int(indices[0]), int(indices[-1]) + 1)
    return indices
