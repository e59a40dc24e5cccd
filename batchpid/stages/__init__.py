"""Stages of a sim step, in their order: a control loop is a list of them.

With setpoint r, joint positions q and velocities v, and passive force p::

    sensors         y    = sensors(q), y' = sensors(v)
    passive force   p    = p(y, y')                       where sensors measure
    inertia         of the friction model                 every 64 sim steps of an env
    matrix          M    = M(y) half way ahead            every 4 sim steps of a tick, 1 with the implicit law
    setpoint        r    = r at this moment of the tick   where its rate is given
    plan            r    = plan(t)                        of chunks of a policy
    guard           r    = guard(r)                       limits of position, rate and acceleration
    feedforward     f    = p + feedforward + modelled friction
    law             u    = the caller's own controller
    limits          of the efforts that the motors deliver
    law             qf   = sat(PID(r, r', r'', y, y') + f), or the engine's drives
    saturation      qf   = sat(u), sat(u + f)             of the caller's efforts
    motors          qf   = motors(qf)
    friction        qf   = qf - friction(qf, v)
    last            qf and the motors' effort             for stages of the caller

Each stage has a file. A stage of the caller's stands behind the one that it names:
:class:`batchpid.stages.stage.Stage`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import is_dataclass
from itertools import product
from typing import Any

import numpy as np

from batchpid.arrays.elementwise import read_only
from batchpid.arrays.trees import leaves, mapped, structure
from batchpid.errors import InvalidArgumentError
from batchpid.law.params import make_params
from batchpid.motors.coupling import Coupling
from batchpid.motors.friction import Friction as JointFriction
from batchpid.native.tracing import Segment, trace_change
from batchpid.stages.control import Control
from batchpid.stages.feedforward import Feedforward, Passive
from batchpid.stages.friction import Friction, Inertia
from batchpid.stages.guard import Guard
from batchpid.stages.law import PID, Drive, Effort, Matrix, Own
from batchpid.stages.motors import Limits, Motors
from batchpid.stages.plan import Plan
from batchpid.stages.sensors import Sensors
from batchpid.stages.setpoint import Setpoint
from batchpid.stages.stage import Last, Stage, outputs_after, running, started
from batchpid.stages.values import Command, Measured, Model, Step, Told, Values

__all__ = [
    "STAGES",
    "Control",
    "Stage",
    "Told",
    "Values",
    "control_segments",
    "fit_stages",
    "stages_of",
]

STAGES: tuple[type[Stage], ...] = (
    *(Sensors, Passive, Inertia, Matrix),
    *(Setpoint, Plan, Guard, Feedforward, Own, Limits),
    *(PID, Drive, Effort, Motors, Friction, Last),
)
"""Stages of batchpid, in order."""


def stages_of(control: Control) -> tuple[Any, ...]:
    """Return the stages of a control, those of the caller behind the ones that they name."""
    kinds: list[Any] = list(STAGES)
    for stage in control.further:
        names = [kind.name for kind in kinds]
        kinds.insert(len(names) - names[::-1].index(stage.after), stage)
    made = [kind if isinstance(kind, Stage) else kind.of(control) for kind in kinds]
    return tuple([stage for stage in made if stage is not None])


def control_segments() -> Iterator[Segment]:
    """Yield the segments of gains per mass matrix with and without friction and damping of the
    joints, and with and without rates of setpoints.
    """
    row = np.ones((1, 1))
    params = make_params(
        1,
        kp=1.0,
        ki=1.0,
        kd=1.0,
        effort_limit=1.0,
        derivative_filter_time=0.01,
        setpoint_weight=0.5,
        anti_windup="conditional",
        measurement_rate="measured",
        gain_units="mass_matrix",
    )
    frictions = JointFriction(), JointFriction(viscous=row), JointFriction(row, row)
    for friction, moves in product(frictions, (False, True)):
        control = Control(
            1.0,
            1,
            Coupling.of(1),
            params,
            friction=friction,
            gravity=True,
            modelled=friction.coulomb,
            band=row,
            damping=friction.viscous,
        )
        stages = [stage for stage in stages_of(control) if not stage.native]
        command, seen = Command(row, row, row, row), Measured(row, row, row)
        values = Values(
            command if moves else command.resting(),
            seen,
            seen,
            step=Step(0, 1, row),
            inertia=(row, row),
            matrix=np.ones((1, 1, 1)),
            model=Model(load=lambda: row),
        )
        states = started(stages, values)
        trees = running(stages), states, values._replace(model=Model())
        histories = (False,) * len(leaves(states))
        yield from trace_change(outputs_after, histories, *map(structure, trees)).program.segments


def fit_stages(stages: Sequence[Stage]) -> tuple[Stage, ...]:
    """Return stages of the caller's, with read-only copies of their constants.

    Raises InvalidArgumentError for one that is not a dataclass of :class:`Stage`, has the name of
    another, or stands behind one that is not there, or behind the last.
    """
    names = [kind.name for kind in STAGES]
    fitted = list[Stage]()
    for stage in stages if isinstance(stages, Sequence) else [stages]:
        if not (isinstance(stage, Stage) and is_dataclass(stage)):
            problem = f"has a {type(stage).__name__}"
            remedy = "make it a frozen dataclass with the base batchpid.stages.Stage"
            raise InvalidArgumentError("stages", problem, remedy=remedy)
        places = [name for name in dict.fromkeys(names) if name != Last.name]
        if stage.name in names or stage.after not in places:
            problem = f"has a stage {stage.name!r} after {stage.after!r}"
            remedy = f"give it a name of its own, and a place after one of {', '.join(places)}"
            raise InvalidArgumentError("stages", problem, remedy=remedy)
        names.append(stage.name)
        copies: Stage = mapped(lambda leaf: read_only(np.array(leaf)), stage)
        fitted.append(copies)
    return tuple(fitted)
