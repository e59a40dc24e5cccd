"""Files: atomic writes and descriptors. Packages: imports at their first use, and the versions that
are written into files.
"""

from __future__ import annotations

import errno
import os
import platform
import secrets
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from signal import SIGINT
from types import MappingProxyType
from typing import Any, BinaryIO

PACKAGES = ("batchpid", "numpy", "sapien", "jax", "h5py", "cmaes", "mujoco", "gymnasium")
"""Packages on which a result may depend."""


@contextmanager
def standard_streams_occupied() -> Iterator[None]:
    """Keep the file descriptors 0 to 2 occupied, so that files opened in the block get larger ones.

    The numbers 0 to 2 belong to the standard streams. In a program that has closed these, the next
    file would get such a number, and printed text would go into it.
    """
    with ExitStack() as files:
        number = 0
        while number <= 2:
            number = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
            files.callback(os.close, number)
        yield


@contextmanager
def replacing(path: str | os.PathLike[str], overwrite: bool = True) -> Iterator[Path]:
    """Yield a path to write a file to, which then replaces the file at ``path``.

    It is in the same folder and has the same suffix. After an exception, a crash or a kill the
    older file is unchanged; a link stays a link. The caller's file is on the disk before it takes
    its place. Without ``overwrite`` a file that exists by then stays. Raises OSError if the file
    cannot be written, FileExistsError for a file that stays.
    """
    path = Path(os.path.realpath(path))
    if path.exists() and not path.is_file():  # a device, which root could replace
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    temporary = path.with_name(f".{secrets.token_hex(8)}{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        if overwrite:
            temporary.replace(path)
        else:
            os.link(temporary, path)  # fails where a file exists by now
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise OSError(
            error.errno, error.strerror, str(path)
        ) from error  # named as the caller named it
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(
    path: str | os.PathLike[str],
    content: str | bytes | Callable[[BinaryIO], object],
    overwrite: bool = True,
) -> None:
    """Write the file at ``path`` as a whole or not at all, as :func:`replacing` does.

    Parameters
    ----------
    content
        Text (UTF-8), bytes, or a function that writes to a binary file, as in
        ``write_atomically(path, lambda file: np.savez(file, **arrays))``.

    Raises
    ------
    OSError
        The file cannot be written, or exists and ``overwrite`` is False.
    """
    with replacing(path, overwrite) as temporary, temporary.open("x+b") as file:
        if callable(content):
            content(file)
        else:
            file.write(content.encode() if isinstance(content, str) else content)


def package_versions(packages: Iterable[str] = PACKAGES) -> dict[str, str]:
    """Return the versions of Python and of the installed ``packages``, by name."""
    from importlib.metadata import PackageNotFoundError, version  # slow to import

    versions = {"python": platform.python_version()}
    for package in packages:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    # This package may run from a checkout whose metadata are older, or are missing.
    return versions | {"batchpid": sys.modules["batchpid"].__version__}


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold SIGINT back while packages are imported; its handler is called at the end of the block.

    Some packages take every exception in an import of theirs for the lack of an optional package,
    KeyboardInterrupt included: Ctrl-C would be lost, and the package would stay half of itself.
    """
    is_main = threading.current_thread() is threading.main_thread()
    # Without a handler of Python there is no KeyboardInterrupt.
    if not is_main or signal.getsignal(SIGINT) is None:
        yield
        return
    held = list[int]()
    handler = signal.signal(SIGINT, lambda number, _: held.append(number))
    try:
        yield
    finally:
        signal.signal(SIGINT, handler)
        if held:
            signal.raise_signal(SIGINT)


def imported(name: str) -> Any:
    """Return a module, imported at its first use with SIGINT held back.

    Raises
    ------
    ImportError
        It is missing.
    """
    if name in sys.modules:
        return import_module(name)
    with uninterrupted():
        return import_module(name)


def attributes_of(
    package: str, modules: Sequence[str], places: Mapping[str, str] = MappingProxyType({})
) -> Callable[[str], Any]:
    """Return the function ``__getattr__`` of a package that imports its public ``modules``, and the
    modules that define the names in ``places``, when they are used.
    """

    def get(name: str) -> Any:
        if name in places:
            return getattr(imported(places[name]), name)
        problem = f"module {package!r} has no attribute {name!r}"
        if name not in modules:
            raise AttributeError(problem)
        try:
            return imported(f"{package}.{name}")
        except ImportError as error:  # help() goes on without it
            raise AttributeError(f"{problem}: {error}") from error

    return get
