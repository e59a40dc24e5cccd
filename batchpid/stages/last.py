"""The efforts of a sim step, for the next one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from batchpid.arrays.elementwise import namespace
from batchpid.stages.control import Control
from batchpid.stages.stage import Stage
from batchpid.stages.values import Outputs, Told, Values


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
