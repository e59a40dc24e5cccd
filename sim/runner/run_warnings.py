"""Warnings of a runner about its gains and what happens to its robots."""

from __future__ import annotations

from batchpid.errors import warn
from batchpid.sim.diagnosis.loop_stability import StabilityCheck
from batchpid.sim.findings import report_shortfalls
from batchpid.sim.loop.faults import FaultLog, FaultWarning
from batchpid.sim.options.options import RunnerOptions
from batchpid.sim.runner.runner_state import RunnerState
from batchpid.sim.tool_space import OperationalSpace
from batchpid.sim.workers.pool import RecoveryWarning


class RunWarnings:
    """Checks of one runner that warn, most of them once."""

    def __init__(self, options: RunnerOptions) -> None:
        robot = options.robot
        shortfalls = options.load_engine().shortfalls(options.scene)
        report_shortfalls(robot.path, options.engine, shortfalls)
        timestep = options.timestep
        control = options.control
        self._control = control
        self._stability = StabilityCheck(robot, timestep) if control == "pid" else None
        self._issued = set[type[Warning]]()

    def check_controller(self) -> None:
        """Warn of unstable operational-space gains."""
        if isinstance(self._control, OperationalSpace):
            self._control.check_stability()

    def check_stability(self, state: RunnerState) -> None:
        """Warn of gains beyond the stability bound of the sampled loop."""
        if self._stability is not None:
            self._stability.check(state.params, state.actuators)

    def issue(self, faults: FaultLog, lost: list[str]) -> None:
        """Warn of lost workers (the messages ``lost``, which are removed) and faults."""
        while lost:
            warn(lost.pop(), RecoveryWarning)
        if faults.events:
            self._warn_once(f"{faults.events[0]}; see runner.faults for more", FaultWarning)

    def _warn_once(self, text: str, kind: type[Warning]) -> None:
        if kind not in self._issued:
            self._issued.add(kind)
            warn(f"{text}; this warning is not repeated", kind)
