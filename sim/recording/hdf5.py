"""Read HDF5 in a child process: on a damaged file its library can hang, crash, or take any amount of memory.

The child runs this file as its program, so the file imports nothing of this project.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import IO, Any

import numpy as np

from batchpid.arrays.array_types import Rows

SECONDS = 4.0
"""Time limit of the child, besides the time to read the file at :data:`SPEED`."""
SPEED = 5e6
"""Lowest speed of a disk that is waited for [B/s]."""
MEMORY = 1 << 30
"""Memory that the child may take [B]; it sends arrays in blocks of :data:`BLOCK`."""
BLOCK = 1 << 23
NOT_WRITTEN = -1
"""Checksum of a row that is not written yet."""
LOG_QUANTITIES = ("setpoint", "effort", "feedforward", "measured_effort", "qpos", "qvel")
"""Quantities of the columns of a log, QUANTITY:JOINT."""
LOG_TIMES = ("time", "time_s", "time_ms", "time_us", "time_ns")
"""Names of the column of the times."""
READ_ATTEMPTS = 24
"""Attempts at metadata that a writer is changing. HDF5 makes 100 and doubles its pause, from 1 ns, after each."""


def read_hdf5(
    path: str | os.PathLike[str], names: Sequence[str] | None, every: int, max_bytes: int
) -> tuple[dict[str, Rows], dict[str, Rows]]:
    """Return the datasets ``names`` of a file, where it has them, and its attributes.

    Without ``names`` the file is read as a log: "time", and the columns of :data:`LOG_QUANTITIES`.

    Every n-th row is read. A recording ends before the first row whose "checksum" (in older files: "time") is not
    written yet; a log is read to its end. Raises ValueError if the file is damaged, lies in several files, or holds
    more than ``max_bytes``.
    """
    request = json.dumps([os.fspath(path), names if names is None else list(names), every, max_bytes, SECONDS])
    environment = os.environ | {"HDF5_PLUGIN_PRELOAD": "::", "OPENBLAS_NUM_THREADS": "1"}  # "::": no plugins
    with subprocess.Popen(
        [sys.executable, "-P", __file__, request],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=environment,
    ) as child:
        assert child.stdout is not None
        try:
            head = json.loads(child.stdout.readline() or "{}")
            arrays = {name: np.empty(shape, dtype) for name, (dtype, shape) in head.get("arrays", {}).items()}
            sent = all(_receive(child.stdout, array) for array in arrays.values())
        finally:
            child.kill()
    if "error" in head:
        raise ValueError(head["error"])
    if "arrays" not in head or not sent:
        ended = "takes too long" if child.returncode == -signal.SIGALRM else "crashed"
        raise ValueError(f"the file is damaged: HDF5 {ended}")
    return arrays, {name: np.array(value, dtype) for name, (dtype, value) in head["attributes"].items()}


def _receive(stream: IO[bytes], array: Rows) -> bool:
    """Fill ``array`` from ``stream``; return whether the stream had so much."""
    return stream.readinto(array.reshape(-1).view(np.uint8)) == array.nbytes  # type: ignore[attr-defined]


def _main() -> None:
    """Answer :func:`read_hdf5`: write a line of JSON with attributes, dtypes and shapes, then the arrays' bytes."""
    path, names, every, max_bytes, seconds = json.loads(sys.argv[1])
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # ends the process, in the midst of HDF5 too
    signal.setitimer(signal.ITIMER_REAL, seconds + os.path.getsize(path) / SPEED)
    import h5py

    with open("/proc/self/statm", encoding="ascii") as pages:
        taken = int(pages.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    out = sys.stdout.buffer
    datasets: dict[str, h5py.Dataset] = {}
    try:
        file = _open(path)
        is_log = names is None
        if is_log:
            columns = [name for name in file if ":" in name and name.partition(":")[0].strip() in LOG_QUANTITIES]
            names = [*(name for name in file if name.strip() in LOG_TIMES), *columns]
        datasets = {name: _open_dataset(file, name) for name in names if file.id.links.exists(name.encode())}
        if (total := sum(dataset.nbytes for dataset in datasets.values())) > max_bytes:
            raise ValueError(f"it holds {total:,} bytes, more than max_bytes={max_bytes:,}")
        count = max(map(len, datasets.values()), default=0) if is_log else _count_rows(datasets)
        sliced = {name: slice(0, min(count, len(dataset)), every) for name, dataset in datasets.items()}
        shapes = {name: (len(range(len(d))[sliced[name]]), *d.shape[1:]) for name, d in datasets.items()}
        attributes = {name: np.asarray(value) for name, value in file.attrs.items()}
        line = json.dumps(
            {
                "attributes": {name: (value.dtype.str, value.tolist()) for name, value in attributes.items()},
                "arrays": {name: (dataset.dtype.str, shapes[name]) for name, dataset in datasets.items()},
            }
        )
    except Exception as error:
        datasets, line = {}, json.dumps({"error": str(error) or type(error).__name__})
    out.write(line.encode() + b"\n")
    for name, dataset in datasets.items():
        stop = sliced[name].stop
        rows = every * max(1, BLOCK * len(dataset) // max(1, dataset.nbytes))
        for first in range(0, stop, rows):
            block = np.ascontiguousarray(dataset[first : min(first + rows, stop) : every])
            out.write(block.data)
    out.flush()
    os._exit(0)  # closing a damaged file can crash


def _open(path: str) -> Any:
    import h5py

    try:
        return h5py.File(path, "r")
    except OSError:  # it is being written, or its writer was killed
        access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
        hdf5 = ctypes.CDLL(h5py.h5p.__file__)  # h5py does not offer this property
        hdf5.H5Pset_metadata_read_attempts(ctypes.c_int64(access.id), ctypes.c_uint(READ_ATTEMPTS))
        return h5py.File(h5py.h5f.open(os.fsencode(path), h5py.h5f.ACC_RDONLY | h5py.h5f.ACC_SWMR_READ, access))


def _open_dataset(file: Any, name: str) -> Any:
    """Return a dataset of numbers, with ticks first, that lies in ``file`` itself; no other file is opened."""
    import h5py

    if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        raise ValueError(f"its {name} is a link to another place")
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset):
        raise ValueError(f"its {name} is not a dataset")
    storage = dataset.id.get_create_plist()
    if storage.get_layout() == h5py.h5d.VIRTUAL or storage.get_external_count():  # before its shape is asked for
        raise ValueError(f"its {name} is stored in other files")
    if dataset.dtype.kind not in "biuf" or not dataset.ndim:
        raise ValueError(f"its {name} is not an array of numbers")
    return dataset


def _count_rows(datasets: Mapping[str, Any]) -> int:
    if not {"checksum", "time"} & set(datasets):
        return max(map(len, datasets.values()), default=0)
    checked = "checksum" in datasets
    written = datasets["checksum"][:] != NOT_WRITTEN if checked else np.isfinite(datasets["time"][:])
    return len(written) if written.all() else int(written.argmin())


if __name__ == "__main__":
    _main()
