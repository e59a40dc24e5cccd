"""Plans: chunks of actions of a slow policy become the setpoint, rate and acceleration of every
step.

Build a plan with :func:`batchpid.make_plan`; thread a state through :func:`add` and
:func:`sample`::

    plan = bp.make_plan(joints=7, period=1 / 30, horizon=16)
    state = bp.plan.init(plan, qpos)
    state = bp.plan.add(plan, state, chunk, time)
    state, setpoint, rate, acceleration = bp.plan.sample(plan, state, t)

See docs/moving-setpoints.md.
"""

from batchpid.plan.plans import (
    Plan,
    dumps_plan,
    load_plan,
    loads_plan,
    make_plan,
    save_plan,
)
from batchpid.plan.sampling import PlanState, add, advance, init, sample

__all__ = [
    "Plan",
    "PlanState",
    "add",
    "advance",
    "dumps_plan",
    "init",
    "load_plan",
    "loads_plan",
    "make_plan",
    "sample",
    "save_plan",
]
