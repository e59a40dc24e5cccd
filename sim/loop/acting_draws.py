"""Robots, params and actuators of a loop, changed by the draws of the randomization."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import batchpid as bp
from batchpid.sim.engine.protocol import EnginePack
from batchpid.sim.engine.scene_spec import SceneSpec, Variation
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.randomization.distributions import Draws
from batchpid.sim.randomization.fields import elements, nominal_values
from batchpid.sim.randomization.randomization import PHYSICAL


def make_pack(
    options: RunnerOptions,
    scene: SceneSpec,
    size: int,
    first_env: int,
    draws: Draws | None,
    workspace: dict[Any, Any],
) -> EnginePack:
    """Return the pack of ``size`` envs; without ``draws`` all robots equal the model."""
    randomization, robot = options.randomization, options.robot
    make = options.load_engine().make_pack
    if randomization is None or not randomization.changes_robot:
        return make(scene, size, first_env, workspace=workspace)
    links = tuple(elements("link_mass", robot))
    scene = replace(scene, carrier=randomization.carrier(robot), varied_links=links)
    return make(scene, size, first_env, variation(options, size, draws), workspace)


def variation(options: RunnerOptions, size: int, draws: Draws | None) -> Variation:
    """Return the differences of ``size`` robots from the model."""
    randomization, robot = options.randomization, options.robot
    assert randomization is not None
    values = {}
    for name in PHYSICAL:
        if name in randomization.given:
            nominal = nominal_values(name, robot, options.mjcf)
            rows = (
                np.tile(nominal, (size, 1))
                if draws is None
                else randomization.apply(name, nominal, draws, robot)
            )
            values[name] = rows / nominal if name == "link_mass" else rows
    for name in ("payload", "ground_friction"):
        if name in values:
            values[name] = values[name][:, 0]
    return Variation(**values)


def acting_params(
    options: RunnerOptions, params: bp.PIDParams, draws: Draws | None
) -> bp.PIDParams:
    """Return ``params`` with the draws applied."""
    randomization = options.randomization
    return (
        params
        if randomization is None
        else randomization.randomized_params(params, draws, options.robot)
    )


def acting_actuators(
    options: RunnerOptions, actuators: bp.Actuators | None, draws: Draws | None
) -> bp.Actuators | None:
    """Return ``actuators`` with the draws applied."""
    randomization = options.randomization
    return (
        actuators
        if randomization is None
        else randomization.randomized_actuators(actuators, draws, options.robot)
    )
