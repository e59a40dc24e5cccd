"""Native calls into the engine: an optional extension that reads and writes all robots of a pack in one call.

The extension calls functions that SAPIEN's shared library exports, so that it needs nothing of SAPIEN to be compiled.
It depends on the layout of two of SAPIEN's types, which no header promises. So it is used only if a self-test in a
child process, where a crash does no harm, gives bit-identical results to Python's calls; the verdict is kept for this
pair of libraries in the user's cache. Otherwise, and with the environment variable ``BATCHPID_NATIVE=0``, Python's
calls do the same work.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib
import json
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.engine.calls import EngineCalls, PythonCalls


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(f"sim.engine.native.{name}")
    except ImportError:
        return None


extension = _imported("_gateway")
batch_extension = _imported("_batch_dynamics")
"""Functions of :mod:`sim.engine.batch_dynamics`; they call nothing of SAPIEN. None if they were not built."""

SWITCH = "BATCHPID_NATIVE"
"""Environment variable: "0" switches the native calls off."""
_VERIFIED = "BATCHPID_NATIVE_VERIFIED"
_SYMBOLS = (  # in the order of the gateway's Functions
    "_ZN6sapien5physx17PhysxArticulation7getQposEv",
    "_ZN6sapien5physx17PhysxArticulation7getQvelEv",
    "_ZN6sapien5physx17PhysxArticulation19computePassiveForceEbb",
    "_ZN6sapien5physx17PhysxArticulation5setQfERKN5Eigen6MatrixIfLin1ELi1ELi0ELin1ELi1EEE",
    "_ZN6sapien5physx14PhysxSystemCpu4stepEv",
)
_CALLBACK = "_ZTVN6sapien5physx20DefaultEventCallbackE"
_ABI = b"system_libstdcpp_gxx_abi_1xxx_use_cxx11_abi_1"
SELF_TEST = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from sim.engine.native_self_test import main; main()"
)
_SECONDS = 60.0


class NativeStatus(NamedTuple):
    """State of the native calls: used or not, and the reason if not."""

    active: bool
    reason: str

    def __str__(self) -> str:
        return "native calls into SAPIEN" if self.active else f"Python calls into SAPIEN ({self.reason})"


def status() -> NativeStatus:
    """Return whether native calls are used; the first call of a new installation runs the self-test (a second)."""
    if os.environ.get(SWITCH) == "0":
        return NativeStatus(False, f"native calls are switched off by {SWITCH}=0")
    return _verified()


@contextlib.contextmanager
def python_calls() -> Iterator[None]:
    """Switch the native calls off for packs and processes that are made within."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = "0"
    try:
        yield
    finally:
        os.environ.pop(SWITCH) if before is None else os.environ.update({SWITCH: before})


@contextlib.contextmanager
def assumed() -> Iterator[None]:
    """Take native calls without a self-test for packs that are made within: for the self-test."""
    os.environ[_VERIFIED] = _fingerprint()
    try:
        yield
    finally:
        os.environ.pop(_VERIFIED)


def environment() -> dict[str, str]:
    """Return the environment that saves a child process of this one the self-test."""
    return {_VERIFIED: _fingerprint()} if status().active else {}


def engine_calls(
    robots: Sequence[Any], systems: Sequence[Any], qf: NDArray[np.float32], skip: NDArray[np.bool_]
) -> EngineCalls:
    """Return native calls where they are available, else Python's; the arguments are those of both."""
    make = NativeCalls if robots and status().active else PythonCalls
    return make(robots, systems, qf, skip)


class NativeCalls:
    """The calls of :class:`sim.engine.calls.PythonCalls`, one for all robots. Raises RuntimeError if SAPIEN does."""

    def __init__(
        self, robots: Sequence[Any], systems: Sequence[Any], qf: NDArray[np.float32], skip: NDArray[np.bool_]
    ) -> None:
        self._objects = [*robots], [*systems]  # kept alive, since the gateway has their pointers
        pointers = [[pointer(item, kind) for item in items] for kind, items in (("robot", robots), ("system", systems))]
        self.gateway = extension.gateway(_functions(), *pointers, qf.shape[1])
        self.systems, self.qf, self.skip = self._objects[1], qf, skip

    def qpos(self, dtype: Any) -> NDArray[Any]:
        """Return the joint positions, a new array."""
        rows = np.empty(self.qf.shape, dtype)
        extension.read_qpos(self.gateway, rows)
        return rows

    def qvel(self, dtype: Any) -> NDArray[Any]:
        """Return the joint velocities, a new array."""
        rows = np.empty(self.qf.shape, dtype)
        extension.read_qvel(self.gateway, rows)
        return rows

    def passive_force(self, gravity: bool, coriolis: bool, dtype: Any) -> NDArray[Any]:
        """Return the efforts that cancel gravity and Coriolis and centrifugal forces, a new array."""
        rows = np.empty(self.qf.shape, dtype)
        extension.passive_force(self.gateway, rows, gravity, coriolis)
        return rows

    def write_qf(self) -> None:
        """Apply the efforts in ``qf``."""
        extension.write_qf(self.gateway, self.qf, self.skip)

    def step(self) -> None:
        """Do one sim step of every system."""
        extension.step(self.gateway)


def pointer(wrapper: Any, kind: str) -> int:
    """Return the address of the C++ object in ``wrapper``, a "robot", "system" or "body".

    It comes by pybind11's conduit, which checks type and ABI.
    """
    capsule = wrapper._pybind11_conduit_v1_(_ABI, extension.type_info(kind), b"raw_pointer_ephemeral")
    if capsule is None:
        raise RuntimeError(f"SAPIEN's {kind} is not of the type that the extension was made for")
    api = ctypes.pythonapi
    name, get = api.PyCapsule_GetName, api.PyCapsule_GetPointer
    name.restype, name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    get.restype, get.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    return get(capsule, name(capsule))


def gateway_address(gateway: Any) -> int:
    """Return the address of what a gateway's capsule holds."""
    return extension.address(gateway)


def gateway_sim_step(address: int, *arrays: NDArray[np.float64]) -> int:
    """Do a sim step of the group at ``address``: see :class:`sim.engine.sim_step.NativeStep`."""
    return extension.sim_step(address, *arrays)


def contact_maps(gateway: Any) -> list[int]:
    """Return the address of the map of contacts of each system of a gateway; 0 if it is not found."""
    vtable = ctypes.addressof(ctypes.c_char.in_dll(ctypes.CDLL(str(_sapien_library())), _CALLBACK))
    return extension.contacts(gateway, vtable)


@cache
def _functions() -> tuple[int, ...]:
    """Return the addresses of the exported functions; AttributeError names one that is missing."""
    library = ctypes.CDLL(str(_sapien_library()))
    return tuple(ctypes.cast(getattr(library, symbol), ctypes.c_void_p).value or 0 for symbol in _SYMBOLS)


@cache
def _sapien_library() -> Path:
    """Return the path of SAPIEN's shared library, which is loaded with its Python package."""
    import sapien  # noqa: F401

    with open("/proc/self/maps", encoding="utf-8", errors="replace") as maps:
        paths = {line.split(maxsplit=5)[-1].strip() for line in maps if "libsapien" in line}
    if len(paths) != 1:
        raise OSError("SAPIEN's shared library is not loaded, or more than once")
    return Path(paths.pop())


@cache
def _fingerprint() -> str:
    """Return a hash of the two libraries."""
    digest = hashlib.blake2b(digest_size=16)
    for path in (_sapien_library(), Path(extension.__file__)):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@cache
def _verified() -> NativeStatus:
    return verify(Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "batchpid"))


def verify(folder: Path, program: str = SELF_TEST) -> NativeStatus:
    """Return whether the native calls work with this SAPIEN: a verdict kept in ``folder``, or that of the self-test.

    ``program`` runs in a child process, with sys.path as JSON in its first argument; it passes by exit status 0. If it
    does not, a RuntimeWarning says so.
    """
    if extension is None:
        return NativeStatus(False, "the extension was not built: it needs a C++ compiler when batchpid is installed")
    try:
        fingerprint = _fingerprint()
        _functions()
        kept = folder / f"native-{fingerprint}"
        known = os.environ.get(_VERIFIED) == fingerprint or kept.is_file()
        problem = None if known else _run(program)
    except (OSError, AttributeError) as error:  # the latter for a function that is not exported
        known, problem = False, str(error)
    if problem is not None:
        warnings.warn(f"native calls do not work with this SAPIEN: {problem}", RuntimeWarning, stacklevel=4)
        return NativeStatus(False, f"the self-test failed: {problem}")
    if not known:
        with contextlib.suppress(OSError):  # the next process tests again
            folder.mkdir(parents=True, exist_ok=True)
            kept.touch()
    return NativeStatus(True, "")


def _run(program: str) -> str | None:
    """Run a Python program in a child process; return what went wrong, None if nothing did."""
    command = [sys.executable, "-P", "-c", program, json.dumps(sys.path)]
    environment = {name: value for name, value in os.environ.items() if name != SWITCH}  # it tests what is switched off
    options: dict[str, Any] = {"env": environment, "stdin": subprocess.DEVNULL, "capture_output": True, "text": True}
    try:
        done = subprocess.run(command, timeout=_SECONDS, **options)
    except subprocess.TimeoutExpired:
        return f"more than {_SECONDS:g} s"
    if done.returncode:
        return (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
    return None
