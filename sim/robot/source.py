"""A robot's file, URDF or MJCF, as the root element of a URDF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lxml import etree

from batchpid.errors import MissingDependencyError
from batchpid.sim.robot.findings import Finding
from batchpid.sim.robot.xml import parse_xml

if TYPE_CHECKING:
    from batchpid.sim.robot.mjcf.mjcf_reader import Mjcf


def is_mjcf(root: etree._Element) -> bool:
    """Return whether a root element is an MJCF file's; MuJoCo ignores a default namespace."""
    return root.prefix is None and etree.QName(root).localname == "mujoco"


def read_source(path: Path, fixed_base: bool, missing_meshes: str) -> tuple[etree._Element, list[Finding], Mjcf | None]:
    """Return the root of the URDF at ``path``, or of one that is equivalent to the MJCF there, and the findings.

    The last value is the rest of an MJCF file, None for a URDF.

    Raises
    ------
    RobotError
        The file cannot be read, or MuJoCo does not compile it.
    MissingDependencyError
        The file is MJCF, and the package ``mujoco`` is missing.
    """
    findings: list[Finding] = []
    root = parse_xml(path, findings)
    if not is_mjcf(root):
        return root, findings, None
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError("mujoco>=3.17", "reading an MJCF file") from error
    from batchpid.sim.robot.mjcf.mjcf_reader import read_mjcf

    mjcf = read_mjcf(path, root.get("model") or path.stem, fixed_base, missing_meshes)
    return mjcf.root, [*findings, *mjcf.findings], mjcf
