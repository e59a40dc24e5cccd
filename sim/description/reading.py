"""Reading of a robot: its file by name or path, as a URDF or an MJCF file, with the .srdf and the
settings beside it.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from batchpid import assets
from batchpid.arrays.elementwise import read_only
from batchpid.checks import file_path, is_name
from batchpid.errors import RobotError, RobotNotFoundError
from batchpid.sim.description.mjcf import read_mjcf
from batchpid.sim.description.tables import DisabledPair, Joint, Settings, Source
from batchpid.sim.description.urdf import read_urdf
from batchpid.sim.description.xml import parse_xml
from batchpid.sim.findings import Finding

ASSETS = Path(assets.__file__).parent
"""Folder of the bundled robots."""


def bundled_robots() -> tuple[str, ...]:
    """Return the names of the robots that ship with batchpid."""
    return tuple(sorted(path.stem for path in ASSETS.glob("*.urdf")))


def find_robot(name_or_path: str | Path) -> Path:
    """Return the path of a bundled robot or of a file. Raises RobotNotFoundError."""
    path = Path(os.path.expanduser(file_path("name_or_path", name_or_path)))
    if str(name_or_path) in bundled_robots():
        return ASSETS / f"{name_or_path}.urdf"
    # pathlib's methods raise other errors for names that are too long or start with ~.
    if os.path.isdir(path):
        raise RobotNotFoundError(f"{path} is a folder; pass the path of a URDF or MJCF file in it")
    if os.path.exists(path):  # also a pipe, such as /dev/stdin
        return path.absolute()
    raise RobotNotFoundError(
        f"no robot {str(name_or_path)!r}: neither bundled ({', '.join(bundled_robots())}) nor a"
        " file; check the spelling, or pass the path of a URDF or MJCF file"
    )


def read_robot(path: Path, fixed_base: bool | None, package_dirs: tuple[Path, ...]) -> Source:
    """Return the robot in the URDF or MJCF file at ``path``, without its .srdf.

    For the arguments see :meth:`batchpid.sim.Robot.load`. Raises RobotError for a file that cannot
    be read, a structure or number without repair, or an MJCF file that MuJoCo does not compile.
    """
    findings: list[Finding] = []
    root = parse_xml(path, findings)
    # MuJoCo ignores a default namespace.
    if root.tag == "mujoco":
        name = root.get("model") or path.stem
        source = read_mjcf(path, name, findings, fixed_base)
    else:
        source = read_urdf(root, path, findings, fixed_base, package_dirs)
    joints = [joint.name for joint in source.tables.joints]
    for name in (source.name, *joints, *source.tables.links):
        if not is_name(name):
            raise RobotError(
                f"{path}: the name {name!r} has a control character or a line break; rename it"
            )
    return source


def with_srdf(source: Source) -> Source:
    """Return ``source`` with the pairs in the .srdf beside its file, if there is one. Any reason of
    a pair counts; a pair without a reason gets "User".

    Pairs that name a link twice or an unknown link are left out, as in MoveIt, with a finding.
    Raises RobotError for what :func:`batchpid.sim.description.xml.parse_xml` refuses.
    """
    path = source.path.with_suffix(".srdf")
    if not os.path.isfile(path):
        return source
    disabled = list(source.disabled)
    enabled = set[frozenset[str]]()
    findings = list(source.repairs)
    for element in parse_xml(path).iterchildren("disable_collisions", "enable_collisions"):
        pair = element.get("link1", ""), element.get("link2", "")
        if len(source.tables.links.keys() & set(pair)) != 2:
            text = (
                f"{path.name}: <{element.tag} link1={pair[0]!r} link2={pair[1]!r}> does not name"
                " two links of the robot"
            )
            findings.append(Finding("self-collision", text, "correct the names; now left out"))
        elif element.tag == "enable_collisions":
            enabled.add(frozenset(pair))
        else:
            disabled.append(DisabledPair(*pair, element.get("reason") or "User"))
    return source._replace(
        disabled=tuple(disabled),
        enabled=frozenset(enabled),
        repairs=tuple(findings),
    )


def read_settings(path: Path, joints: tuple[Joint, ...]) -> Settings | None:
    """Return the settings beside the file of a bundled robot, None for another robot."""
    if path.parent != ASSETS:
        return None
    import yaml  # here, so that `batchpid --help` does not load it

    data = yaml.safe_load(path.with_suffix(".yaml").read_text())
    rows = [data["joints"][joint.name] for joint in joints]
    keys = ("start", "target", "kp", "ki", "kd")
    columns = {key: read_only(np.array([row[key] for row in rows], float)) for key in keys}
    return Settings(
        **columns,
        drive_stiffness=float(data["drive"]["stiffness"]),
        drive_damping=float(data["drive"]["damping"]),
        rate_hz=float(data["rate_hz"]),
        notes=tuple(data.get("notes", ())),
    )
