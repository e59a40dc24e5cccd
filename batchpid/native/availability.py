"""Whether native code is used, or the reason why not."""

from __future__ import annotations

import os
from functools import cache

from batchpid.errors import warn
from batchpid.native.array_program import interpreter
from batchpid.native.extensions import PROGRAM, TASK_SPACE, Extension, StaleExtensionError, load

SWITCH = "BATCHPID_NATIVE"
"""Environment variable: "0" switches native code off."""


def obstacle(*extensions: Extension) -> str:
    """Return why native code is not used, "" if it is; a faulty installation gives one
    RuntimeWarning per process.

    ``extensions`` are needed besides the extensions of this package.
    """
    if os.environ.get(SWITCH) == "0":
        return f"native code is switched off by {SWITCH}=0"
    return _fault((PROGRAM, TASK_SPACE)) or _fault(extensions)


@cache
def _fault(extensions: tuple[Extension, ...]) -> str:
    try:
        for extension in extensions:
            load(extension)
        interpreter()
    except StaleExtensionError as error:
        warn(f"native code is not used, only Python: {error}", RuntimeWarning)
        return str(error)
    except ModuleNotFoundError as error:
        return str(error)
    return ""
