"""Mesh files of a URDF: the search for them, their reading, and their content.

trimesh reads the files. Engines get vertices, and read no file themselves.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from batchpid.arrays.trees import digest
from batchpid.errors import RobotError
from batchpid.io.files import imported

LARGEST_NUMBER = 1e18
"""Largest magnitude of a number of a file, whose square fits in single precision."""
LFS_POINTER = b"version https://git-lfs"
"""Beginning of git-lfs's file in place of another."""
MESH_FORMATS = (".stl", ".obj", ".dae", ".glb")
MESH_SIZE_LIMIT = 2**27  # bytes of a mesh file
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("attributes", "<u2")])
"""Row of a binary STL."""
LFS_PROBLEM = "a git-lfs pointer instead of the mesh: run git lfs pull"


def find_mesh(name: str, path: Path, package_dirs: tuple[Path, ...]) -> Path | None:
    """Return the mesh file that the URDF at ``path`` refers to as ``name``, or None if it does not
    exist.

    ``package://`` and ``model://`` paths are looked up in ``package_dirs``, in the folders above
    the URDF, and in those of AMENT_PREFIX_PATH and ROS_PACKAGE_PATH, with the name of the package
    and, in a folder that is the package under another name, without it. Other paths are relative to
    the URDF's folder, or to one of these. The suffix may be in the other case, and the name
    percent-encoded.
    """
    # As in xacro, and on Windows.
    slashes = name.strip().replace("\\", "/")
    name = re.sub(r"^(file:/*)?\$\(find ([^)]+)\)", r"package://\2", slashes)
    spellings = dict.fromkeys([name, unquote(name)])
    # The places are a generator: nearly every mesh is at the first one.
    for change in (str, str.lower, str.upper, str.title):
        for spelling in spellings:
            for place in _candidates(spelling, path, package_dirs):
                stem, suffix = os.path.splitext(place)
                if os.path.isfile(file := stem + change(suffix)):
                    return Path(file).absolute()
    return None


def _candidates(name: str, path: Path, package_dirs: tuple[Path, ...]) -> Iterator[Path]:
    """Yield the files that ``name`` may mean, the likeliest first."""
    # ROS 2 installs, then ROS 1 workspaces.
    prefixes, workspaces = (
        [Path(folder) for folder in os.environ.get(variable, "").split(os.pathsep) if folder]
        for variable in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH")
    )
    shares = [prefix / "share" for prefix in prefixes]
    folders = (*package_dirs, *path.absolute().parents, *shares, *workspaces)
    package = re.match(r"(?:package|model):/+([^/]+/(.+))", name)
    if package is None:
        # A plain path may be relative to any folder above, as in a package.
        relative = re.sub(r"^file:(//(localhost)?)?", "", name)
        yield from (folder / relative for folder in (path.absolute().parent, *folders))
    else:
        for relative in package.groups():
            yield from (folder / relative for folder in folders)


def read_mesh(path: str | Path, data: bytes) -> Any:
    """Return the result of ``trimesh`` for the bytes of a mesh file, in metres.

    Raises errors of many types.
    """
    kind = Path(path).suffix.lower().removeprefix(".")
    # Materials are textures to decode, of which nothing here needs any.
    load = imported("trimesh").load
    mesh: Any = load(
        BytesIO(data),
        file_type=kind,
        force="mesh",
        process=False,
        skip_materials=True,
    )
    # Of COLLADA: "0.01 * meters".
    factor, _, unit = str(mesh.metadata.get("units", "")).partition(" * ")
    # trimesh leaves the vertices in the file's unit.
    if unit == "meters":
        mesh.vertices = np.asarray(mesh.vertices) * float(factor)
    return mesh


_PROBLEMS: dict[tuple[str, str], str | None] = {}
"""Problem of each content that was checked, by format: robots of a family share meshes, and most
are loaded again.
"""


def check_mesh(path: Path) -> tuple[str, str | None]:
    """Return the digest of the bytes of a mesh file, and the reason for which it cannot be used, or
    None.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(MESH_SIZE_LIMIT + 1)
    except OSError as error:
        return "", str(error)
    content = digest(data)
    key = content, path.suffix.lower()
    if key not in _PROBLEMS:
        _PROBLEMS[key] = _problem(path, data)
    return content, _PROBLEMS[key]


def _problem(path: Path, data: bytes) -> str | None:
    """Return the reason for which the bytes of a mesh file cannot be used, or None."""
    suffix = path.suffix.lower()
    if suffix not in MESH_FORMATS:
        return f"format not among {', '.join(MESH_FORMATS)}"
    if not data:
        return "empty"
    if len(data) > MESH_SIZE_LIMIT:
        return f"larger than {MESH_SIZE_LIMIT >> 20} MiB"
    if data.startswith(LFS_POINTER):
        return LFS_PROBLEM
    try:
        count = int.from_bytes(data[80:84], "little")
        if suffix == ".stl" and len(data) == 84 + _TRIANGLE.itemsize * count:
            # Most meshes of robots are such rows, which take a tenth of trimesh's time.
            corners = np.frombuffer(data, _TRIANGLE, offset=84)["corners"]
        else:
            mesh = read_mesh(path, data)
            corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    except Exception as error:
        return str(error) or type(error).__name__
    if not len(corners):
        return "damaged, or without faces"
    if (np.abs(corners) <= LARGEST_NUMBER).all():
        return None
    return f"vertices beyond {LARGEST_NUMBER:g} m"


def mesh_bytes(path: str, content: str) -> bytes:
    """Return the bytes of a mesh file with this digest.

    Raises RobotError if it cannot be read, or has another one.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise RobotError(f"{error}; restore the mesh, or load the robot again") from None
    if digest(data) != content:
        raise RobotError(f"{path}: has changed since the robot was loaded; load it again")
    return data
