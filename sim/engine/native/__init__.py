"""Native extensions: programs on arrays, dynamics of many robots, and calls into SAPIEN.

Where they are not used, and with the environment variable ``BATCHPID_NATIVE=0``, Python does the same work.
"""

from __future__ import annotations

from batchpid.sim.engine.native.verdict import (
    SWITCH,
    NativeStatus,
    environment,
    extension,
    python_calls,
    status,
    take_verdict,
    verify,
)

__all__ = [
    "SWITCH",
    "NativeStatus",
    "environment",
    "extension",
    "python_calls",
    "status",
    "take_verdict",
    "verify",
]
