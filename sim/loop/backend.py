"""How law and sim steps run under the options of a runner: in native code, XLA or NumPy, and why."""

from __future__ import annotations

import batchpid as bp
from batchpid.native.operations import MOST_SUMMED
from batchpid.sim.engine import native
from batchpid.sim.engine.native import xla
from batchpid.sim.engine.protocol import Engine
from batchpid.sim.options import RunnerOptions
from batchpid.sim.tool_space.osc_controller import OperationalSpace


def obstacle(options: RunnerOptions, actuators: bp.Actuators | None) -> str:
    """Return why backend "jax" cannot run the sim steps of a tick as one program of XLA; "" if it can."""
    if not options.robot.coupling.is_identity:
        return "coupled joints take constraint efforts of NumPy"
    if options.randomization is not None or actuators is not None or options.robot.actuators is not None:
        return "actuators and randomizations are in NumPy"
    if options.guard is not None:
        return "the guard of setpoints is in NumPy"
    if not options.robot.fixed_base and options.robot.friction.any():
        return "joints with friction on a floating base take an inertia of NumPy"
    engine = options.load_engine()
    return _engine_obstacle(engine) or _force_obstacle(engine, options) or engine.native_obstacle() or xla.obstacle()


def _engine_obstacle(engine: Engine) -> str:
    """Return why the engine has no native sim steps; "" if it has."""
    return "" if "compiled_steps" in engine.capabilities else f"the sim steps of {engine.name!r} are calls of Python"


def _force_obstacle(engine: Engine, options: RunnerOptions) -> str:
    """Return why the engine's native sim steps do not read the passive force; "" if they do."""
    if "gravity" not in options.compensate:
        return ""
    if not options.robot.fixed_base and "base_state" not in engine.capabilities:
        return f"{engine.title} needs NumPy for the passive force of a floating base"
    if "coriolis" not in options.compensate and "partial_force" not in engine.capabilities:
        return f"{engine.title} needs NumPy for gravity without Coriolis forces"
    return ""


def native_obstacle(options: RunnerOptions) -> str:
    """Return why the sim steps of a tick cannot be one native call, without XLA; "" if they can."""
    control = options.control
    if isinstance(control, OperationalSpace):
        if not control.is_native:
            return "the law of a subclass of OperationalSpace is one of Python"
    elif not isinstance(control, str):
        return "the controller is one of Python"
    if options.robot.dof > MOST_SUMMED:
        return f"more than {MOST_SUMMED} joints"
    return _engine_obstacle(options.load_engine())


def describe(options: RunnerOptions, actuators: bp.Actuators | None) -> str:
    """Describe the library of the law, and the calls into the engine, with reasons."""
    engine = options.load_engine()
    lack = engine.native_obstacle()
    calls = native.describe_calls(engine.title, lack)
    drives = options.control == "drive"
    if drives or options.backend == "numpy" or (options.control == "effort" and obstacle(options, actuators)):
        reason = "" if lack else native_obstacle(options)
        each = f", a call each sim step ({reason})" if reason else ""
        if drives:
            return f"law in {engine.title} (control 'drive'){each}, {calls}"
        return f"law {'in NumPy' if lack or reason else 'as a native program'}{each}, {calls}"
    reason = obstacle(options, actuators)
    law = f"law in XLA ({options.dtype})"
    if not reason:
        return f"{law}, in one program with native sim steps"
    return f"{law}, a call each sim step ({reason}), {calls.partition(' (')[0]}"
