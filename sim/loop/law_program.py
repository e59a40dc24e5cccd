"""The law of the control "pid" as a native program (:mod:`batchpid.native`).

In a sim step the law makes some thirty calls of NumPy. The program is traced from
:meth:`batchpid.sim.loop.pid_law.PIDLaw.advance`, so that there is only one definition of the law.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.law.coefficients import Coefficients
from batchpid.native.array_program import ArrayProgram
from batchpid.native.compiled_law import structure
from batchpid.native.operations import MOST_SUMMED
from batchpid.native.symbols import Symbol
from batchpid.native.tracing import Trace, trace
from batchpid.sim.engine import native
from batchpid.sim.loop.pid_law import PIDLaw


@lru_cache(maxsize=256)
def _trace_law(law: PIDLaw, structures: tuple[tuple[Any, ...], ...], observed: bool) -> tuple[Trace, list[int]]:
    """Return the law's trace, and the indices of the state leaves that it returns, before effort and saturation.

    ``structures`` describe coefficients, state and other inputs: ``...`` for each array, other values unchanged.
    """
    returned: list[int] = []

    def function(*symbols: Symbol) -> list[Any]:
        rest = iter(symbols)
        k, state, inputs = ([next(rest) if one is ... else one for one in leaves] for leaves in structures)
        setpoint, rate, *others = inputs
        new, effort, saturated = partial(law.advance, observed=observed)(
            Coefficients(*k), bp.PIDState(*state), (setpoint, rate), *others
        )
        returned[:] = [at for at, leaf in enumerate(new) if leaf is not None]
        return [*(new[at] for at in returned), effort, *([saturated] if observed else [])]

    counts = [leaves.count(...) for leaves in structures]
    return trace(function, counts[0], counts[1] + counts[2]), returned


class LawProgram:
    """:meth:`batchpid.sim.loop.pid_law.PIDLaw.advance` for given coefficients ``k`` (envs, joints), of float64."""

    def __init__(self, law: PIDLaw, k: Coefficients) -> None:
        self._law = law
        self._k = structure(k)
        self._constants = [leaf for leaf in k if isinstance(leaf, np.ndarray)]
        self._shape = k.kp.shape
        self._programs: dict[Any, tuple[ArrayProgram, list[int]]] = {}

    @staticmethod
    def available(k: Coefficients) -> bool:
        """Return whether the extension can run the law with these coefficients."""
        return k.kp.dtype == np.float64 and k.kp.shape[1] <= MOST_SUMMED and native.status().active

    def as_advance(self, law: PIDLaw, k: Coefficients, *inputs: Any, observed: bool = False) -> tuple[Any, ...]:
        """Return the result of :meth:`PIDLaw.advance` for the law and the coefficients of this program."""
        return self.advance(*inputs, observed=observed)

    def advance(
        self,
        state: bp.PIDState,
        command: tuple[Any, Any],
        qpos: NDArray[np.float64],
        qvel: NDArray[np.float64] | None,
        *others: NDArray[np.float64] | None,
        observed: bool = False,
    ) -> tuple[Any, ...]:
        """Return the new state, the effort, and the mask of saturated joints, or None unless ``observed``.

        Arguments as in :meth:`batchpid.sim.loop.pid_law.PIDLaw.advance`.
        """
        inputs = (*command, qpos, qvel if self._law.measures_rate else None, *others)
        leaves = (*state, *inputs)
        key = (observed, *[leaf is None for leaf in leaves])
        if key not in self._programs:
            structures = (self._k, structure(state), structure(inputs))
            traced, returned = _trace_law(self._law, structures, observed)
            count = len(leaves) - sum(key[1:])
            self._programs[key] = ArrayProgram(traced, self._constants, count, self._shape), returned
        program, returned = self._programs[key]
        outputs = program(*[leaf for leaf in leaves if leaf is not None])
        new: list[Any] = [None] * len(state)
        for at, leaf in zip(returned, outputs, strict=False):
            new[at] = leaf
        return bp.PIDState._make(new), outputs[len(returned)], outputs[-1] if observed else None
