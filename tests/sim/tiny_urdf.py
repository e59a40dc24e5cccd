"""Small URDFs for tests: links and joints, with the oddities that a test asks for."""

from __future__ import annotations

from pathlib import Path

INERTIAL = '<inertial><mass value="1"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>'
LIMIT = '<limit lower="-1" upper="1" effort="10" velocity="2"/>'


def link(name: str, inner: str = INERTIAL) -> str:
    return f'<link name="{name}">{inner}</link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", inner: str = LIMIT, origin: str = "0 0 1") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{origin}"/><axis xyz="0 1 0"/>{inner}</joint>'
    )


def robot(*parts: str, head: str = "") -> str:
    return f'<?xml version="1.0"?>{head}<robot name="test">{"".join(parts)}</robot>'


def one_joint(inner: str = LIMIT, kind: str = "revolute", arm: str = INERTIAL) -> str:
    return robot(link("base"), link("arm", arm), joint("hinge", "base", "arm", kind, inner))


def write(folder: Path, text: str, name: str = "test.urdf") -> Path:
    path = folder / name
    path.write_text(text)
    return path
