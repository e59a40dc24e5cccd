"""Mesh files of a URDF: the search for them, and a check of their headers and sizes.

SAPIEN silently drops a collision shape whose file it cannot read, and trusts the sizes in a header: 20 bytes can cost
gigabytes. Formats other than those checked here are refused: in some, a truncated file ends the process.
"""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from batchpid.arrays.digest import digest
from batchpid.errors import RobotError
from batchpid.sim.robot.xml import LARGEST, LFS_POINTER

SIZE_LIMIT = 2**27  # bytes of a mesh file
LFS_PROBLEM = "a git-lfs pointer instead of the mesh: run git lfs pull"
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


def find_mesh(name: str, path: Path, package_dirs: tuple[Path, ...]) -> Path | None:
    """Return the mesh file that the URDF at ``path`` refers to as ``name``, or None if it does not exist.

    ``package://`` and ``model://`` paths are looked up in ``package_dirs``, in the folders above the URDF, and in those
    of AMENT_PREFIX_PATH and ROS_PACKAGE_PATH, with the name of the package and, in a folder that is the package under
    another name, without it. Other paths are relative to the URDF's folder, or to one of these. The suffix may be in
    the other case, and the name percent-encoded.
    """
    name = re.sub(r"^(file:/*)?\$\(find ([^)]+)\)", r"package://\2", name.strip().replace("\\", "/"))  # xacro, Windows
    tried = []
    for spelling in dict.fromkeys([name, unquote(name)]):
        for each in _candidates(spelling, path, package_dirs):
            if os.path.isfile(each):
                return each.absolute()
            tried.append(os.path.splitext(each))
    for change in (str.lower, str.upper, str.title):
        for stem, suffix in tried:
            if os.path.isfile(found := stem + change(suffix)):
                return Path(found).absolute()
    return None


def _candidates(name: str, path: Path, package_dirs: tuple[Path, ...]) -> Iterator[Path]:
    """Yield the files that ``name`` may mean, the likeliest first."""
    scheme, _, relative = name.rpartition("://")
    above = path.absolute().parents
    if scheme in ("package", "model"):
        relative = relative.lstrip("/")
        package, _, within = relative.partition("/")
        if within:
            yield from (folder / relative for folder in (*package_dirs, *above))
            yield from (folder / within for folder in (*package_dirs, *above))
            yield from (folder / within for folder in _ros_packages(package))
        return
    if not scheme and name.startswith("file:"):
        relative = name.removeprefix("file:")
    elif scheme == "file":
        relative = relative.removeprefix("localhost")
    if relative.strip("/"):
        yield from (folder / relative for folder in (above[0], *package_dirs, *above[1:]))


def _ros_packages(package: str) -> Iterator[Path]:
    """Yield the folders of a ROS package that the environment names: ROS 2 installs, then ROS 1 workspaces."""
    if not re.fullmatch(r"\w[\w.-]*", package):
        return
    prefixes, roots = (
        [Path(each) for each in os.environ.get(variable, "").split(os.pathsep) if each]
        for variable in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH")
    )
    yield from (prefix / "share" / package for prefix in prefixes)
    for root in roots:
        if root.name == package:
            yield root
        for pattern in (package, f"*/{package}", f"*/*/{package}"):  # rospack searches any depth
            yield from sorted(root.glob(pattern))


def read_mesh(path: str | Path) -> Any:
    """Return the result of ``trimesh`` for a mesh file, in metres. Raises errors of many types."""
    from trimesh import load

    mesh: Any = load(path, force="mesh", process=False)
    factor, _, unit = str(mesh.metadata.get("units", "")).partition(" * ")  # of COLLADA: "0.01 * meters"
    if unit == "meters":
        mesh.vertices = np.asarray(mesh.vertices) * float(factor)
    return mesh


_in_use: dict[str, str] = {}
"""Digests of the mesh files that SAPIEN has read in this process; it never reads the same path again."""


def note_meshes(paths: Iterable[str]) -> None:
    """Record the digests of mesh files that SAPIEN reads."""
    for path in {*paths} - _in_use.keys():
        with suppress(OSError):  # SAPIEN's error says more
            _in_use[path] = digest(Path(path).read_bytes())


def check_unchanged(path: Path) -> None:
    """Raise RobotError if a mesh file has changed since SAPIEN read it in this process."""
    if (known := _in_use.get(str(path))) is not None and digest(path.read_bytes()) != known:
        problem = f"{path}: has changed since this process simulated it, and SAPIEN keeps the mesh that it read first"
        raise RobotError(f"{problem}; start Python again, or save the mesh under another name")


def content_of(urdf: str) -> str:
    """Return the text of a URDF in canonical form, with the digest of each mesh file in place of its path.

    Raises RobotError for a file that cannot be read.
    """
    root = etree.fromstring(urdf.encode(), etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True))
    digests: dict[str, str] = {}
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        try:
            digests[name] = digests.get(name) or digest(Path(name).read_bytes())
        except OSError as error:
            raise RobotError(
                f"{name}: cannot be read: {error.strerror}; restore the mesh, or load the robot again"
            ) from None
        mesh.set("filename", digests[name])
    return etree.tostring(root, method="c14n", with_comments=False).decode()


def mesh_problem(path: Path) -> str | None:
    """Return the reason for which SAPIEN cannot use a mesh file, or None if the check of its format finds none."""
    check = _CHECKS.get(path.suffix.lower())
    if check is None:
        return f"format not among {', '.join(_CHECKS)}"
    try:
        with open(path, "rb") as file:
            data = file.read(SIZE_LIMIT + 1)
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    if data.startswith(LFS_POINTER):
        return LFS_PROBLEM
    if not data or len(data) > SIZE_LIMIT:
        return f"larger than {SIZE_LIMIT >> 20} MiB" if data else "empty"
    try:
        return None if check(data) else "damaged or truncated"
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, etree.XMLSyntaxError):
        return "damaged"


def _stl(data: bytes) -> bool:
    """84 bytes with the number of triangles and 50 for each; or text, to its last keyword."""
    count = int.from_bytes(data[80:84], "little")
    if count and len(data) == 84 + 50 * count:
        return bool((np.abs(np.frombuffer(data, _TRIANGLE, offset=84)["corners"]) <= LARGEST).all())
    return data.lstrip().startswith(b"solid") and b"facet" in data and b"endsolid" in data[-1024:]


def _obj(data: bytes) -> bool:
    """Three vertices and a face, of numbers, and no face of other vertices."""
    vertices, faces = (re.findall(rb"^[ \t]*%b[ \t](.*)$" % kind, data, re.M) for kind in (b"v", b"f"))
    corners = _numbers(b" ".join(vertices))
    indices = _numbers(re.sub(rb"/\S*", b"", b" ".join(faces)))
    inside = (indices != 0) & (np.abs(indices) <= len(vertices))
    return len(vertices) >= 3 and len(indices) >= 3 and bool((np.abs(corners) <= LARGEST).all() and inside.all())


def _numbers(text: bytes) -> NDArray[np.float64]:
    """Return the numbers in ``text``, separated by blanks. Raises ValueError if there is anything else."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # NumPy's report of a word that is not a number
        try:
            return np.fromstring(text.decode("ascii"), sep=" ")
        except DeprecationWarning as error:
            raise ValueError(str(error)) from error


def _dae(data: bytes) -> bool:
    """Well-formed, with faces, as many coordinates as it says, and no count beyond them."""
    root = etree.fromstring(data, etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True))
    geometry = "{*}library_geometries//{*}"
    arrays, accessors = root.findall(geometry + "float_array"), root.findall(geometry + "accessor")
    faces = [face for kind in ("triangles", "polylist", "polygons") for face in root.findall(geometry + kind)]
    sizes = {"#" + array.attrib["id"]: len((array.text or "").split()) for array in arrays}
    complete = all(int(array.attrib["count"]) == sizes["#" + array.attrib["id"]] for array in arrays)
    ends = [int(each.attrib["count"]) * int(each.get("stride", 1)) + int(each.get("offset", 0)) for each in accessors]
    inside = all(0 <= end <= sizes[each.attrib["source"]] for end, each in zip(ends, accessors, strict=True))
    counted = all(0 < int(face.attrib["count"]) <= len(data) for face in faces)
    counted &= all("".join((index.text or "").split()).isdigit() for face in faces for index in face.iter("{*}p"))
    return bool(arrays and faces) and complete and inside and counted


def _glb(data: bytes) -> bool:
    """Header and chunks within the file; meshes; no other file. glTF 2.0 specification, section 4."""
    words = np.frombuffer(data[:20], "<u4")
    size, end = int(words[2]), 20 + int(words[3])
    if data[:4] != b"glTF" or words[1] != 2 or size > len(data) or end > size or data[16:20] != b"JSON":
        return False
    content = json.loads(data[20:end])
    inside = all(buffer.get("uri", "data:").startswith("data:") for buffer in content.get("buffers", []))
    binary = end == size or end + 8 + int.from_bytes(data[end : end + 4], "little") <= size
    return bool(content["meshes"]) and inside and binary


_CHECKS: dict[str, Callable[[bytes], bool]] = {".stl": _stl, ".obj": _obj, ".dae": _dae, ".glb": _glb}
