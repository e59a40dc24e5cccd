"""Friction and damping of a robot's joints, from its description, its variation and its actuators."""

from __future__ import annotations

import numpy as np

from batchpid.motors import Actuators
from batchpid.motors.friction import Friction
from batchpid.sim.engine.scene_spec import SceneSpec, Variation
from batchpid.sim.robot.dissipation import DISSIPATION
from batchpid.sim.robot.mimics import coupling_of


def own_friction(spec: SceneSpec, variation: Variation | None = None) -> Friction:
    """Return the friction and damping that the loop applies to robots of ``spec``, with ``variation``."""
    model = Friction()
    if DISSIPATION[spec.dissipation].modelled:
        rows = (np.array([[getattr(joint, name) for joint in spec.joints]]) for name in ("friction", "damping"))
        model = Friction(*(row if row.any() else None for row in rows))
    if variation is not None and variation.friction is not None:
        # The coupling moves the others.
        model = model._replace(coulomb=coupling_of(spec.joints).of_independent(variation.friction))
    if variation is not None and variation.damping is not None:
        model = model._replace(viscous=variation.damping.copy())
    return model if spec.mjcf is None else model._replace(viscous=None)  # there MuJoCo computes the damping


def added_friction(own: Friction, actuators: Actuators | None) -> Friction:
    """Return ``own`` friction and damping plus the actuators' friction and damping."""
    added = Actuators() if actuators is None else actuators
    static, load = added.static, added.load_friction
    both = zip(own[:2], (added.coulomb, added.viscous), strict=True)
    coulomb, viscous = (one if more is None else more if one is None else one + more for one, more in both)
    if static is not None:
        static = static if own.coulomb is None else static + own.coulomb
    if coulomb is None and (rubs := Friction(None, None, static, load=load).most) is not None:
        coulomb = np.zeros_like(rubs)
    return Friction(coulomb, viscous, static, added.stribeck, load)
