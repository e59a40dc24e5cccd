"""Verdict on the native extensions: used or not, and why not.

They are used if all of them were built from the present tables and sources (:mod:`batchpid.native.extensions`),
and if a self-test in a child process, where a crash does no harm, gives the results of Python. The verdict of the
self-test is kept in the user's cache, under a hash of its inputs. A process passes its verdict on to its child
processes, so that one warning is shown and one self-test is run for all of them.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from batchpid.native.availability import SWITCH
from batchpid.native.extensions import ROOT, StaleExtensionError, load, load_all
from batchpid.native.operations import PROGRAM
from batchpid.sim.engine.native.interface import EXTENSIONS
from batchpid.sim.engine.native.library import sapien_library

_VERIFIED, _REFUSED = "BATCHPID_NATIVE_VERIFIED", "BATCHPID_NATIVE_REFUSED"
"""Environment variables of child processes: fingerprint of a verdict to use the extensions, or reason not to."""
_SWITCHED_OFF = f"native calls are switched off by {SWITCH}=0"
SELF_TEST = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from batchpid.sim.engine.native_self_test import main; main()"
)
_SECONDS = 60.0
_python_calls: ContextVar[bool] = ContextVar("_python_calls", default=False)
_lock = threading.Lock()
_verdict: NativeStatus | None = None


class NativeStatus(NamedTuple):
    """State of the native calls: used or not, and the reason if not."""

    active: bool
    reason: str = ""
    warning: str = ""
    """Text of a warning, if the reason is a fault of the installation."""

    def describe(self, engine: str) -> str:
        """Return the kind of the calls into ``engine``, with the reason."""
        return f"native calls into {engine}" if self.active else f"Python calls into {engine} ({self.reason})"


def status() -> NativeStatus:
    """Return whether native calls are used; the first call of a new installation runs the self-test (a second)."""
    global _verdict
    if _python_calls.get() or os.environ.get(SWITCH) == "0":
        return NativeStatus(False, _SWITCHED_OFF)
    if (known := _verdict) is not None:
        return known
    with _lock:
        is_first = _verdict is None
        if _verdict is None:
            _verdict = verify(Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "batchpid"))
        known = _verdict
    if is_first and known.warning:
        warnings.warn(known.warning, RuntimeWarning, stacklevel=3)
    return known


@contextlib.contextmanager
def python_calls() -> Iterator[None]:
    """Switch the native calls off for packs and processes that this thread makes in the ``with`` block."""
    token = _python_calls.set(True)
    try:
        yield
    finally:
        _python_calls.reset(token)


def environment() -> dict[str, str]:
    """Return the environment variables that pass the verdict to a child process."""
    known = status()
    return {_VERIFIED: _fingerprint()} if known.active else {_REFUSED: known.reason}


def take_verdict(environment: dict[str, str]) -> None:
    """Take the :func:`environment` of a parent process, in a process that could not be started with it."""
    os.environ.update(environment)


def verify(folder: Path, program: str = SELF_TEST) -> NativeStatus:
    """Return whether the extensions work here, by a verdict stored in ``folder`` or by the self-test.

    ``program`` runs in a child process, with sys.path as JSON in its first argument; it passes by exit status 0.
    """
    if reason := os.environ.get(_REFUSED):
        return NativeStatus(False, reason)
    try:
        extensions()
    except StaleExtensionError as error:
        return NativeStatus(False, str(error), f"the native extensions are not used, only Python: {error}")
    except ModuleNotFoundError as error:
        return NativeStatus(False, str(error))
    try:
        fingerprint = _fingerprint()
        kept = folder / f"native-{fingerprint}"
        known = os.environ.get(_VERIFIED) == fingerprint or kept.is_file()
        problem = None if known else _run(program, fingerprint)
    except OSError as error:
        known, problem = False, str(error)
    if problem is not None:
        warning = f"native calls do not work with this SAPIEN: {problem}"
        return NativeStatus(False, f"the self-test failed: {problem}", warning)
    if not known:
        with contextlib.suppress(OSError):  # the next process tests again
            folder.mkdir(parents=True, exist_ok=True)
            kept.touch()
    return NativeStatus(True)


@cache
def _fingerprint() -> str:
    """Return a hash of the inputs of the self-test: libraries, Python code, versions and the processor."""
    digest = hashlib.blake2b(digest_size=16)
    code = [file for package in ("batchpid", "sim/engine", "sim/robot") for file in (ROOT / package).rglob("*.py")]
    library = [sapien_library()] if find_spec("sapien") else []
    for path in (*library, *(module.__file__ for module in extensions()), *sorted(code)):
        content = Path(path).read_bytes()
        digest.update(len(content).to_bytes(8, "little") + content)
    digest.update(repr((sys.version, np.__version__, platform.platform(), _processor())).encode())
    return digest.hexdigest()


def _processor() -> list[str]:
    """Return the features of the processor that NumPy may use."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
        found = sorted({line for line in lines if line.startswith(("flags", "Features"))})
        return [*found, *(os.environ.get(f"NPY_{verb}_CPU_FEATURES", "") for verb in ("DISABLE", "ENABLE"))]
    return []


def _run(program: str, fingerprint: str) -> str | None:
    """Run a Python program in a child process that uses the extensions without a test; return the problem, or None."""
    command = [sys.executable, "-P", "-c", program, json.dumps(sys.path)]
    environment = {name: value for name, value in os.environ.items() if name != SWITCH} | {_VERIFIED: fingerprint}
    options: dict[str, Any] = {"env": environment, "stdin": subprocess.DEVNULL, "capture_output": True, "text": True}
    try:
        done = subprocess.run(command, timeout=_SECONDS, **options)
    except subprocess.TimeoutExpired:
        return f"more than {_SECONDS:g} s"
    if done.returncode:
        return (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
    return None


def extension(name: str) -> Any:
    """Return the extension ``name`` of :data:`interface.EXTENSIONS`; errors as :func:`batchpid.native.extensions.load`.

    It does not depend on the verdict.
    """
    return load(EXTENSIONS[name])


def extensions() -> list[Any]:
    """Return all extensions, the one for programs included; errors as :func:`batchpid.native.extensions.load_all`."""
    return load_all((*EXTENSIONS.values(), PROGRAM))
