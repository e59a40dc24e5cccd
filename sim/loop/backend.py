"""How law and sim steps run under the options of a runner: in native code, JAX or NumPy, and
why.
"""

from __future__ import annotations

from batchpid.native.extensions import MOST_SUMMED
from batchpid.sim.engine import native
from batchpid.sim.loop.group_control import untraceable
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.tool_space import OperationalSpace


def native_obstacle(options: RunnerOptions) -> str:
    """Return why the sim steps of a tick cannot be one native call; "" if they can."""
    if options.backend == "jax":
        return "the control is compiled by JAX"
    control = options.control
    if isinstance(control, OperationalSpace):
        if type(control) is not OperationalSpace:
            return "a subclass of OperationalSpace runs in Python"
    elif not isinstance(control, str):
        return "the controller runs in Python"
    if options.robot.dof > MOST_SUMMED:
        return f"more than {MOST_SUMMED} joints"
    return untraceable(options) if options.stages else ""


def describe(options: RunnerOptions) -> str:
    """Describe the library of the law, and the calls into the engine, with reasons."""
    engine = options.load_engine()
    lack = engine.native_obstacle()
    reason = "" if lack else native_obstacle(options)
    if options.backend == "jax":
        law = "in JAX"
    elif lack or reason:
        law = "in NumPy"
    else:
        law = "as a native program"
    if options.control == "drive":
        law = f"in {engine.title} (control 'drive')"
    if reason:
        steps = f", one call per sim step ({reason})"
    else:
        steps = ""
    return f"law {law}{steps}, {native.describe_calls(engine.title, lack)}"
