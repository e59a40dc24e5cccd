"""Robots, params and actuators of a group of envs, changed by the draws of the randomization."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import batchpid as bp
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.engine.scene_spec import SceneSpec, Variation
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import Draws, elements, nominal_values
from batchpid.sim.randomization.randomization import PHYSICAL


class ActingDraws:
    """Params and actuators of a group, with the draws of its envs applied.

    Attributes
    ----------
    draws
        Draws of the envs; None before the first reset. A reset, or new params, put them into
        effect.
    params, actuators
        As they were given.
    acting_params
        With the draws in effect.
    motors
        Actuators with the draws in effect; None without an effect on efforts or measurements.
    """

    def __init__(self, options: RunnerOptions, params: bp.PIDParams) -> None:
        self._options = options
        self.draws: Draws | None = None
        self.params = self.acting_params = params
        self.actuators: bp.Actuators | None = None
        self.motors: bp.Actuators | None = None

    def set_params(self, params: bp.PIDParams) -> None:
        """Put params into effect."""
        randomization = self._options.randomization
        robot = self._options.robot
        self.params = self.acting_params = params
        if randomization is not None:
            self.acting_params = randomization.randomized("params", params, self.draws, robot)

    def set_actuators(self, actuators: bp.Actuators | None) -> bp.Actuators | None:
        """Put actuators into effect; return them with the draws applied."""
        randomization = self._options.randomization
        robot = self._options.robot
        self.actuators = actuators
        if randomization is not None:
            actuators = randomization.randomized("actuators", actuators, self.draws, robot)
        self.motors = effective(actuators)
        return actuators


def effective(actuators: bp.Actuators | None) -> bp.Actuators | None:
    """Return ``actuators`` if they have an effect on efforts or measurements, else None."""
    if actuators is not None and (actuators.measures or actuators.delivers):
        return actuators
    return None


def make_pack(
    options: RunnerOptions,
    scene: SceneSpec,
    size: int,
    first_env: int,
    draws: Draws | None,
    workspace: dict[Any, Any],
) -> EnginePack:
    """Return the pack of ``size`` envs; without ``draws`` all robots equal the model."""
    randomization = options.randomization
    make = options.load_engine().make_pack
    if randomization is None or not randomization.changes_robot:
        return make(scene, size, first_env, workspace=workspace)
    links = tuple(elements("link_mass", options.robot))
    scene = replace(scene, carrier=randomization.carrier(options.robot), varied_links=links)
    return make(scene, size, first_env, variation(options, size, draws), workspace)


def variation(options: RunnerOptions, size: int, draws: Draws | None) -> Variation:
    """Return the differences of ``size`` robots from the model."""
    randomization = options.randomization
    robot = options.robot
    assert randomization is not None
    values = {}
    for name in PHYSICAL:
        if getattr(randomization, name) is None:
            continue
        nominal = nominal_values(name, robot, options.mjcf)
        rows = np.tile(nominal, (size, 1))
        if draws is not None:
            rows = randomization.apply(name, nominal, draws, robot)
        # Masses vary by a factor, the others by their value.
        if name == "link_mass":
            rows = rows / nominal
        if name in ("payload", "ground_friction"):
            values[name] = rows[:, 0]
        else:
            values[name] = rows
    return Variation(**values)
