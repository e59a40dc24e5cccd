"""Identification of a robot's motors from logs: motion to record, logs, regression, fit and
report.
"""

from batchpid.sim.identification.excitation import excite
from batchpid.sim.identification.identification import identify
from batchpid.sim.identification.log import Log
from batchpid.sim.identification.log_files import logs_of_rollout, read_logs
from batchpid.sim.identification.result import draw_motors

__all__ = [
    "Log",
    "draw_motors",
    "excite",
    "identify",
    "logs_of_rollout",
    "read_logs",
]
