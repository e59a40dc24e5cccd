"""A stage of the control of robots, and the functions of a list of stages.

A stage is a frozen dataclass of its constants. Its memory from one sim step to the next is its
state; its results go to the stages after it in :class:`batchpid.stages.values.Values`. So a list of
stages is a tree of arrays, and their states are another: a snapshot holds the states by name, a
restart of some envs is :func:`started` under a mask, and a native program is a trace of
:func:`stepped`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

from batchpid.arrays.array_types import Array, Pytree
from batchpid.arrays.elementwise import replace_envs
from batchpid.stages.control import Control
from batchpid.stages.values import Told, Values

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
    native: ClassVar[str] = ""
    """Kind of stage in tick.h that replaces ``step`` in native code; "": a trace of ``step`` runs."""
    calls_model: ClassVar[bool] = False
    """Whether ``step`` calls functions of the robots' model, which no program has."""
    is_brief: ClassVar[bool] = False
    """Whether each tick makes its state anew, so that snapshots do not hold it."""
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

    @property
    def every(self) -> int:
        """Sim steps of a tick from one run of a native stage to the next."""
        return 1

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


def placed(
    stages: Iterable[Any],
    states: States,
    values: Values,
    mask: Array,
) -> States:
    """Return the states with the envs of ``mask`` (M,) started."""
    placed: States = replace_envs(states, started(stages, values), mask)
    return placed


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
