"""Way in which law and sim steps are run, by the options of a runner."""

from __future__ import annotations

import batchpid as bp
from batchpid.sim.engine import native
from batchpid.sim.engine.native import xla
from batchpid.sim.options import RunnerOptions
from batchpid.sim.tool_space.osc_controller import OperationalSpace


def obstacle(options: RunnerOptions, actuators: bp.Actuators | None) -> str:
    """Return why the sim steps of a tick cannot be one program of XLA, under backend "jax"; or nothing."""
    if options.robot.coupling is not None:
        return "coupled joints take constraint efforts of NumPy"
    if options.randomization is not None or actuators is not None or options.robot.actuators is not None:
        return "actuators and randomizations are in NumPy"
    if options.guard is not None:
        return "the guard of setpoints is in NumPy"
    if not options.robot.fixed_base and options.robot.friction.any():
        return "joints with friction on a floating base take an inertia of NumPy"
    engine = options.load_engine()
    if "compiled_steps" not in engine.capabilities:
        return f"the sim steps of {engine.name!r} are calls of Python"
    if "gravity" in options.compensate and "partial_force" not in engine.capabilities:
        if not options.robot.fixed_base:
            return f"{engine.title} needs NumPy for the passive force of a floating base"
        if "coriolis" not in options.compensate:
            return f"{engine.title} needs NumPy for gravity without Coriolis forces"
    status = xla.status()
    return "" if status.active else status.reason


def describe(options: RunnerOptions, actuators: bp.Actuators | None) -> str:
    """Return the library of the law, and the kind of the calls into the engine, with reasons."""
    engine = options.load_engine().title
    calls = native.status().describe(engine)
    if options.control == "drive":
        return f"law in {engine} (control 'drive'), {calls}"
    if options.backend == "numpy":
        compiled = (
            options.control == "pid" or isinstance(options.control, OperationalSpace)
        ) and native.status().active
        return f"law {'as a native program' if compiled else 'in NumPy'}, {calls}"
    reason = obstacle(options, actuators)
    law = f"law in XLA ({options.dtype})"
    if not reason:
        return f"{law}, in one program with native sim steps"
    return f"{law}, a call each sim step ({reason}), {calls.partition(' (')[0]}"
