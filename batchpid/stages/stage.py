"""A stage of the control of robots, and the functions of a list of stages.

A stage is a frozen dataclass of its constants. Its memory from one sim step to the next is its
state; its results go to the stages after it in :class:`batchpid.stages.values.Values`. So a list of
stages is a tree of arrays, and their states are another: a snapshot holds the states by name, a
restart of some envs is :func:`started` under a mask, and a native program is a trace of
:func:`stepped`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from batchpid.arrays.array_types import Array, Pytree
from batchpid.arrays.elementwise import namespace
from batchpid.arrays.trees import mapped
from batchpid.native.array_program import Bound, TreeProgram
from batchpid.stages.control import Control
from batchpid.stages.values import Outputs, Told, Values

States = tuple[Pytree, ...]
"""State of each stage, a tree of arrays (M, ...)."""


class Stage:
    """Stage of a sim step: the base of frozen dataclasses of constants.

    ``init`` and ``step`` are pure functions of arrays, for NumPy and JAX. A ``step`` with operations
    of :mod:`batchpid.native.extensions` alone runs in native code, too.
    """

    name: ClassVar[str]
    """Name of its state in snapshots."""
    after: ClassVar[str]
    """Name of the stage before it, for a stage of the caller's."""
    native = ""
    """Entry of StageKind in tick.h that replaces ``step`` in native code; "": a trace of ``step`` runs."""
    every = 1
    """Sim steps of a tick from one run of a native stage to the next."""
    calls_model = False
    """Whether ``step`` calls functions of the robots' model, which no program has."""
    is_brief = False
    """Whether the state is made at the start of each tick, so that snapshots do not hold it."""
    starting: ClassVar[tuple[str, ...]] = ()
    """Constants that only ``init`` needs."""
    due: ClassVar[tuple[str, ...]] = ()
    """Two fields of the state: the time of an env, and the time from which :meth:`renewed` changes
    its state; () for never.
    """

    @classmethod
    def of(cls, control: Control) -> Any:
        """Return the stage of a control, or None where it does not apply. Stages of the caller's
        are made by the caller.
        """
        raise NotImplementedError

    def init(self, values: Values) -> Told:
        """Return the state of envs at their start, and the values for the stages after it."""
        return (), values

    def renewed(self, state: Any) -> Any:
        """Return the state for the next sim step, before ``step``, changed where its time is due."""
        return state

    def step(self, state: Any, values: Values) -> Told:
        """Return the state after a sim step, and the values for the stages after it."""
        raise NotImplementedError

    def adopt(self, before: Any, state: Any, values: Values) -> Pytree:
        """Return the state of the stage ``before`` as a state of this stage, which replaces it."""
        return state

    def bind(self, program: Any, state: Any, values: Values) -> Values:
        """Give a native stage its arrays; return the values after it."""
        raise NotImplementedError


def running(stages: Iterable[Any]) -> tuple[Any, ...]:
    """Return stages without the constants that only ``init`` needs, for programs."""
    return tuple([replace(stage, **dict.fromkeys(stage.starting)) for stage in stages])


def stepped(stages: Sequence[Any], states: States, values: Values) -> tuple[States, Values]:
    """Advance stages by a sim step; return their states, and the values after them."""
    return advanced(stages, renewed(stages, states), values)


def renewed(stages: Sequence[Any], states: States) -> States:
    """Return the states for the next sim step: :meth:`Stage.renewed`."""
    pairs = zip(stages, states, strict=True)
    return tuple([stage.renewed(state) if stage.due else state for stage, state in pairs])


def advanced(stages: Sequence[Any], states: States, values: Values) -> tuple[States, Values]:
    """Advance stages by a sim step, from :func:`renewed` states on."""
    new = list[Pytree]()
    values = recalled(stages, states, values)
    for stage, state in zip(stages, states, strict=True):
        state, values = stage.step(state, values)
        new.append(state)
    return tuple(new), values


def started(stages: Iterable[Any], values: Values) -> States:
    """Return the states of envs at their start: each stage gets the values of those before it."""
    states = list[Pytree]()
    for stage in stages:
        state, values = stage.init(values)
        states.append(state)
    return tuple(states)


def adopted(
    stages: Iterable[Any], before: Mapping[str, tuple[Any, Pytree]], values: Values
) -> States:
    """Return the states of new stages, which go on from the stages and states ``before``, by
    name.
    """
    states = list[Pytree]()
    for stage in stages:
        if stage.name in before:
            state = stage.adopt(*before[stage.name], values)
            # Other options may need more or fewer arrays.
            if hasattr(state, "matched_to"):
                state = state.matched_to(stage.init(values)[0])
        else:
            state, values = stage.init(values)
        states.append(state)
    return tuple(states)


def recalled(stages: Sequence[Any], states: States, values: Values) -> Values:
    """Return ``values`` with the efforts of the sim step before, if the last stage keeps them."""
    if stages and stages[-1].name == "last":
        return values._replace(last=states[-1])
    return values


def by_name(stages: Iterable[Any], states: States) -> dict[str, Pytree]:
    """Return the states by the names of their stages, as a snapshot holds them."""
    pairs = zip(stages, states, strict=True)
    return {stage.name: state for stage, state in pairs if not stage.is_brief}


@dataclass(frozen=True)
class Last(Stage):
    """Keeps ``qf`` and ``motor`` for the stages of the caller, which find them in
    :attr:`.Values.last`.
    """

    name = "last"

    @classmethod
    def of(cls, control: Control) -> Self | None:
        return cls() if control.further else None

    def init(self, values: Values) -> Told:
        qpos = values.measured.qpos
        zero = namespace(qpos).zeros_like(qpos)
        return Outputs(qf=zero, motor=zero), values

    def step(self, state: Outputs, values: Values) -> Told:
        outputs = values.outputs
        return Outputs(qf=outputs.qf, motor=outputs.motor), values


def bind_stages(
    stages: Sequence[Any],
    states: States,
    values: Values,
    shape: tuple[int, int],
    passes: bool = False,
    renews: bool = False,
) -> tuple[Bound, Values]:
    """Return a program of stages, their states, and the values before them, whose arrays it reads;
    and the values after them.

    It changes the arrays of ``states`` in place. It makes new arrays for the ``values`` that it
    changes: for the outputs alone, or with ``passes`` for all, which stages after it read. With
    ``renews`` it is :func:`renewed`. Errors as for :class:`.TreeProgram`.
    """
    constants = mapped(_split, running(stages))
    # Programs have no keys of noise, counts, or state of a controller.
    states = mapped(_number, tuple(states))
    function: Callable[..., tuple[States, Outputs, Any]] = outputs_after
    if renews:
        function = _renewed_states
    elif passes:
        function = _values_after
    bound = TreeProgram(function, constants, states, values, shape).bind(states, values)
    _, outputs, others = bound.after
    after = others._replace(noise=None) if passes else values
    return bound, after._replace(outputs=outputs)


def _values_after(stages: Any, states: States, values: Values) -> tuple[States, Outputs, Values]:
    states, values = advanced(stages, states, values)
    return states, values.outputs, values._replace(outputs=Outputs())


def outputs_after(stages: Any, states: States, values: Values) -> tuple[States, Outputs, Any]:
    """Return the states and results of a sim step, as for :class:`.TreeProgram`."""
    return *_values_after(stages, states, values)[:2], ()


def _renewed_states(stages: Any, states: States, _: Values) -> tuple[States, Outputs, Any]:
    return renewed(stages, states), Outputs(), ()


def _number(array: Array) -> Any:
    """Return an array of numbers in double precision; None for another."""
    return array if array.dtype == np.float64 else None


def _split(array: Array) -> Any:
    """Return an array (n, envs, dof) as a tuple of n arrays, and other arrays unchanged."""
    return tuple(array) if array.ndim == 3 else array
