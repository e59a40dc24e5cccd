"""Precautions before other modules are imported: on the import path, and against tracebacks of Ctrl-C in the command.

At the top it imports nothing that Python has not loaded at its start.
"""

from __future__ import annotations

import os
import sys

IMPORTED = """
    abc argparse ast asyncio base64 cloudpickle cmaes collections concurrent contextlib copy copyreg csv ctypes
    dataclasses datetime decimal enum errno fcntl fractions functools glob gymnasium gzip h5py hashlib hmac http
    imageio_ffmpeg importlib inspect io ipaddress itertools jax json logging lxml math matplotlib mimetypes mmap
    msgspec mujoco multiprocessing numbers numpy operator os pathlib pickle PIL platform queue random ray re reprlib
    resource rosbags ruckig sapien scipy secrets select shutil signal socket ssl stable_baselines3 stat statistics
    string struct subprocess tabulate tempfile textwrap threading token tokenize tqdm traceback trimesh types typing
    tyro urllib uuid viser warnings weakref websockets yaml zipfile zlib
""".split()  # noqa: SIM905
"""Modules that this project imports, and some that these import."""


def prepare() -> None:
    """Check the import path; of the command ``batchpid``, leave the working folder out and end quietly on Ctrl-C.

    Raises ImportError if a file in the program's folder hides a module that this project imports.
    """
    if _is_command():
        if not sys.flags.safe_path and sys.argv[0] == "-m" and sys.path[0] != _package_folder():
            del sys.path[0]  # the working folder, which may hold a stranger's json.py
        import signal

        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, exit_at_once)
    elif hiding := _hiding_file(sys.path):
        name = os.path.basename(hiding).removesuffix(".py")
        raise ImportError(f"{hiding} hides the module {name!r} that batchpid needs; rename it or run in another folder")


def exit_at_once(*_: object) -> None:
    """End the process on Ctrl-C, as long as there is nothing to clean up: an import can lose a KeyboardInterrupt."""
    try:
        os.write(2, b"batchpid: interrupted\n")
    finally:
        os._exit(130)


def _package_folder() -> str:
    return os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


def _is_command() -> bool:
    """Return whether this process is ``python -m batchpid`` or the script ``batchpid`` of the installation."""
    program = sys.argv[0] if getattr(sys, "argv", None) else ""
    if program == "-m":  # followed by the arguments of the module
        return sys.orig_argv[-len(sys.argv)].removeprefix("-m") == "batchpid"
    return os.path.basename(program) == "batchpid"


def _hiding_file(path: list[str]) -> str | None:
    """Return a file in the first folder of ``path`` that is imported instead of a module of the same name, if any."""
    from importlib.machinery import PathFinder

    for name in IMPORTED if path and not sys.flags.safe_path else ():
        file = os.path.join(os.path.abspath(path[0]), f"{name}.py")
        if not os.path.isfile(file) or name in sys.builtin_module_names:
            continue
        loaded = getattr(sys.modules.get(name), "__file__", file)  # those that Python has loaded at its start are safe
        hidden = PathFinder.find_spec(name, path[1:])
        if loaded == file and hidden is not None and hidden.origin != file:
            return file
    return None
