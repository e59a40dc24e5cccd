"""Reader of robots' files, URDF or MJCF."""

from __future__ import annotations

from pathlib import Path

from lxml import etree

from batchpid.errors import RobotError
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.mjcf_reader import read_mjcf
from batchpid.sim.robot.urdf import Source, read_urdf
from batchpid.sim.robot.xml import parse_xml


def read_robot(
    path: Path, fixed_base: bool | None, package_dirs: tuple[Path, ...], missing_meshes: str
) -> Source:
    """Return the robot in the URDF or MJCF file at ``path``.

    For the arguments see :meth:`batchpid.sim.Robot.load`.

    Raises
    ------
    RobotError
        A file that cannot be read, a structure or number that SAPIEN cannot build, a bad mesh, or
        an MJCF file that MuJoCo does not compile.
    """
    findings: list[Finding] = []
    root = parse_xml(path, findings)
    if not is_mjcf(root):
        return read_urdf(root, path, findings, fixed_base, package_dirs, missing_meshes)
    # MuJoCo opens the file by its path, and workers do so again.
    if not path.is_file():
        raise RobotError(f"{path}: an MJCF file is read several times; save it as a file first")
    name = root.get("model") or path.stem
    try:
        source = read_mjcf(path, name, fixed_base, missing_meshes)
    except UnicodeDecodeError as error:
        raise RobotError(
            f"{path}: a name is not UTF-8, which MuJoCo requires: {error}; save it as UTF-8"
        ) from error
    return source._replace(repairs=(*findings, *source.repairs))


def is_mjcf(root: etree._Element) -> bool:
    """Return whether a root element is an MJCF file's; MuJoCo ignores a default namespace."""
    return root.prefix is None and etree.QName(root).localname == "mujoco"
