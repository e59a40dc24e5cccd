"""Stages of a sim step compiled by JAX, between sim steps of the engine."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from itertools import groupby
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Array, Pytree
from batchpid.arrays.jax_settings import precision
from batchpid.arrays.trees import filled, leaves, structure
from batchpid.sim.loop.group_control import GroupControl
from batchpid.sim.loop.numpy_executor import NumPyExecutor
from batchpid.stages.stage import States, recalled, running, stepped
from batchpid.stages.values import Model, Values

ROWS = 16
"""Number of which the rows in a program are a multiple.

One program then serves all groups, and the results of an env do not depend on its group.
"""


_KEPT_VALUES = ("measured", "timestep", "step", "model", "matrix", "inertia")
"""Values that stages in programs do not change."""


class JAXExecutor(NumPyExecutor):
    """A :class:`.NumPyExecutor` whose stages are programs of JAX, on the CPU.

    Neighbours are one program. Between them are the stages that call functions of the robots'
    model.
    """

    def __init__(self, setup: GroupControl, states: States) -> None:
        super().__init__(setup, states)
        self._parts = list[tuple[slice, Any]]()
        first = 0
        for calls_model, group in groupby(map(_traceable, setup.stages), _calls_model):
            part = running(group)
            program = None
            if not calls_model:
                program = partial(_compiled(structure(part)), self._constants(part))
            self._parts.append((slice(first, first + len(part)), program))
            first += len(part)

    def _constants(self, part: Any) -> list[Any]:
        """Return the constants of stages as arrays of JAX, with one row for each robot where they
        have rows.
        """
        import jax

        with precision("float64"):
            rows = [self._padded(leaf, leaf.ndim - 2) for leaf in leaves(part)]
            return list(jax.device_put(rows, jax.local_devices(backend="cpu")[0]))

    def _padded(self, rows: Any, axis: int = 0) -> Any:
        """Return ``rows`` with copies of the first robot's on an axis, up to a multiple of ROWS."""
        size = self.setup.pack.size
        # Copies of a robot stay finite, which rows of zeros need not.
        if axis < 0 or np.ndim(rows) <= axis or rows.shape[axis] != size or size % ROWS == 0:
            return rows
        return np.take(rows, [*range(size), *[0] * (-size % ROWS)], axis)

    def _stepped(self, values: Values) -> Values:
        import jax

        size = self.setup.pack.size
        stages, states = self.setup.stages, self._states
        values = recalled(stages, states, values)
        new = list[Pytree]()
        with precision("float64"):
            for part, program in self._parts:
                if program is None:
                    changed, values = stepped(stages[part], states[part], values)
                else:
                    inputs = states[part], _without(values, "model")
                    results = program(*jax.tree.map(self._padded, inputs))
                    changed, after = jax.tree.map(lambda rows: np.asarray(rows)[:size], results)
                    unchanged = {name: getattr(values, name) for name in _KEPT_VALUES}
                    values = after._replace(**unchanged)
                new += changed
        self._states = tuple(new)
        return values


def _without(values: Values, *names: str) -> Values:
    nothing: dict[str, Any] = dict.fromkeys(names)
    return values._replace(**nothing)


def _calls_model(stage: Any) -> bool:
    calls_model: bool = stage.calls_model
    return calls_model


def _traceable(stage: Any) -> Any:
    """Return a stage with the function of the caller's controller for programs."""
    controller = getattr(stage, "controller", None)
    return stage if controller is None else replace(stage, controller=controller.traced)


@lru_cache(maxsize=8)
def _compiled(stages: Any) -> Any:
    """Return the sim step of stages of this structure, compiled at its first call: (constants,
    (states, values)) -> states and values.
    """
    import jax

    def step(constants: list[Array], states: States, values: Values) -> tuple[States, Values]:
        values = values._replace(model=Model())
        states, values = stepped(filled(stages, iter(constants)), states, values)
        return states, _without(values, *_KEPT_VALUES)

    return jax.jit(step, compiler_options={"xla_cpu_multi_thread_eigen": False})
