"""Friction and damping of the joints of a pack: the model of :mod:`batchpid.friction` in the loop."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid import friction
from batchpid.elementwise import TURN, namespace, wrap
from sim.engine.protocol import EnginePack as Pack
from sim.loop.arrays import Command
from sim.loop.snapshot import AGE
from sim.robot.dissipation import DISSIPATION
from sim.robot.mimics import coupling_of

Float64 = NDArray[np.float64]

REFRESH_STEPS = 64
"""Sim steps of an env for which the inertia that its joints show is kept."""
BAND = {"rad": 1e-4, "m": 2e-5}
"""Half width, by the joint's unit, in which the compensation is less than the friction."""


class KnownFriction(NamedTuple):
    """Friction that the compensation cancels, arrays (dof,)."""

    friction: Any
    """[N m or N]"""
    band: Any
    """Half width in which the compensation is less [rad or m]."""
    turns: Any
    """1 / (2 pi) on continuous joints, 0 elsewhere; None without such joints."""

    def feedforward(self, command: Command, qpos: Any) -> Any:
        """Return the efforts that cancel it on the way to the setpoint of ``command`` (M, dof), for NumPy and JAX."""
        error = wrap(command.setpoint - qpos, self.turns, namespace(qpos))
        return friction.compensation(self.friction, error, command.setpoint_rate, self.band)


class JointFriction:
    """Friction model of the M robots of ``pack``; it owns the model's state.

    Attributes
    ----------
    acts
        Whether there is any friction or damping to apply.
    compensates
        Whether :meth:`feedforward` has friction to cancel.
    drive
        Damping and stiffness of the engine's drives, (1, dof) or (M, dof) [N m s/rad, N m/rad].
    """

    def __init__(self, pack: Pack, drive: tuple[Any, Any] = (0.0, 0.0), coulomb: Any = 0.0) -> None:
        """``coulomb`` (dof,) is known to the controller in addition to the description's."""
        self._pack, self.drive = pack, drive
        self._coupling = coupling_of(pack.spec.joints)
        joints = pack.spec.joints
        modelled = DISSIPATION[pack.spec.dissipation].modelled
        # The controller knows the URDF's.
        self._known = np.array([joint.friction * modelled for joint in joints]) + coulomb
        self._band = np.array([BAND[joint.unit] for joint in joints])
        turns = np.array([joint.continuous / TURN for joint in joints])
        self._turns = turns if turns.any() else None
        self.compensates = bool(self._known.any())
        self._state = friction.FrictionState()
        # Counted from an env's own reset: its motion must not depend on how long the runner has run.
        self._age = np.zeros(pack.size, np.int64)
        self.update()

    def update(self) -> None:
        """Take the friction of the pack, which has changed; the state carries on."""
        self.acts = any(leaf is not None for leaf in self._model)
        if self._model.coulomb is None:
            self._state = friction.FrictionState()
        elif self._state.effort is None:
            self.reset(np.ones(self._pack.size, bool))
        else:
            self._age[:] = REFRESH_STEPS

    @property
    def _model(self) -> friction.Friction:
        return self._pack.friction

    def reset(self, mask: NDArray[np.bool_]) -> None:
        """Reset the envs of ``mask`` (M,), which were placed."""
        if self._model.coulomb is None:
            return
        pack = self._pack
        velocity, load = pack.read_qvel(), pack.passive_force(True, True)
        if self._coupling is not None:
            load = self._coupling.efforts(load)
        fresh = friction.init(self._model, velocity, load, self._mass_matrix(), pack.spec.timestep, *self.drive)
        self._state = fresh if self._state.effort is None else friction.reset(self._state, fresh, mask)
        self._age[mask] = 0

    @property
    def model(self) -> friction.Friction:
        """Friction and damping that act."""
        return self._model

    @property
    def known(self) -> KnownFriction:
        """Friction that the compensation cancels."""
        return KnownFriction(self._known, self._band, self._turns)

    def feedforward(self, command: Command, qpos: Float64) -> Float64:
        """Return the efforts that cancel the known friction on the way to the setpoint of ``command`` (M, dof)."""
        return self.known.feedforward(command, qpos)

    def effort(self, motor: Float64, qvel: Float64) -> Float64:
        """Return the efforts to apply in the next sim step (M, dof)."""
        if self._model.coulomb is not None:
            if (due := self._age == REFRESH_STEPS).any():
                timestep = self._pack.spec.timestep
                fresh = friction.refresh(self._model, self._state, self._mass_matrix(), timestep, *self.drive)
                self._state = friction.reset(self._state, fresh, due)
                self._age[due] = 0
            self._age += 1
        self._state, total = friction.advance(self._model, self._state, motor, qvel)
        return total

    def read(self) -> dict[str, NDArray[Any]]:
        """Return the state of the model by name, for :meth:`write`."""
        if self._state.effort is None:
            return {}
        return {**self._state._asdict(), AGE: self._age.copy()}

    def write(self, state: dict[str, NDArray[Any]]) -> None:
        """Set the state of the model."""
        if state:
            self._state = friction.FrictionState(**{name: state[name] for name in friction.FrictionState._fields})
            self._age = state[AGE].copy()

    def _mass_matrix(self) -> Float64:
        pack = self._pack
        matrix = pack.joint_mass_matrix(pack.read_qpos())
        if pack.armature.any():
            matrix = matrix + pack.armature[:, None] * np.eye(pack.dof)
        return matrix if self._coupling is None else self._coupling.mass_matrix(matrix)
