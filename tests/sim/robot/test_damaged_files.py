"""A damaged URDF or .srdf loads or is refused by an error of ours, within seconds and a bounded
memory.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_meshes import GOOD, arm
from tiny_urdf import INERTIAL, LIMIT, joint, link, one_joint, robot

from batchpid import assets
from batchpid.errors import RobotError
from batchpid.sim import Robot, Runner

BOX = (
    '<collision><origin xyz="0 0 1" rpy="0 0 0.1"/><geometry><box size="1 1'
    ' 1"/></geometry></collision>'
)
PAIR = '<disable_collisions link1="base" link2="arm" reason="Default"/>'
SOURCES = {path.name: path.read_bytes() for path in Path(assets.__file__).parent.glob("*.urdf")}
SOURCES |= {
    "one joint": (
        one_joint(LIMIT + '<dynamics damping="1" friction="0.1"/>', arm=INERTIAL + BOX).encode()
    ),
    "mimic": (
        robot(
            *map(link, ("base", "l", "r", "tip")),
            joint("left", "base", "l"),
            joint(
                "right",
                "base",
                "r",
                inner=LIMIT + '<mimic joint="left" multiplier="-1" offset="0"/>',
            ),
            joint("end", "r", "tip", "fixed"),
        ).encode()
    ),
    "mesh": arm("mesh.stl").encode(),
}
SRDF = robot(PAIR, PAIR.replace("Default", "Never")).encode()
NAMES = sorted(SOURCES)
SNIPPETS = [
    b"",
    b"nan",
    b"inf",
    b"-1",
    b"1e300",
    b"1e-300",
    b"0",
    b'"',
    b"<",
    b"/>",
    b"<link/>",
    b"<collision>",
    b"&a;",
]
SNIPPETS += [
    b"\0",
    b"\xff\xfe",
    b"9" * 5000,
    b"<x>" * 300,
    b"mesh.stl",
    b"<?xml version='1.0' encoding='utf-7'?>",
]


@st.composite
def damaged(draw: st.DrawFn, data: bytes) -> bytes:
    """Draw ``data`` with flipped bits, replaced parts or a cut."""
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(data)))
        kind = draw(st.sampled_from(["flip", "replace", "cut"]))
        if kind == "flip" and at < len(data):
            data = data[:at] + bytes([data[at] ^ 1 << draw(st.integers(0, 7))]) + data[at + 1 :]
        elif kind == "replace":
            data = (
                data[:at] + draw(st.sampled_from(SNIPPETS)) + data[at + draw(st.integers(0, 40)) :]
            )
        elif kind == "cut":
            data = data[:at] if draw(st.integers(0, 9)) == 0 else data
    return data


def try_loading(path: Path, build: bool) -> None:
    """Load a robot and ``build`` a scene of it: an error is one of ours, and neither takes long nor
    much memory.
    """
    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    try:
        loaded = Robot.load(path)
        if build:
            with Runner(loaded, 1, workers=0, params=loaded.params(kp=1.0), substeps=1) as runner:
                runner.step(loaded.start)
    except RobotError:
        pass
    assert time.process_time() - started < 5
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kB


def fuzz(count: int, folder: Path, built: Collection[str]) -> None:
    path, srdf, mesh = (folder / name for name in ("test.urdf", "test.srdf", "mesh.stl"))

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=st.data())
    def run(data: st.DataObject) -> None:
        target = data.draw(st.sampled_from([*NAMES, "srdf", "stl"]), label="damaged file")
        base = target if target in SOURCES else {"srdf": "one joint", "stl": "mesh"}[target]
        contents = {path: SOURCES[base], srdf: SRDF, mesh: GOOD["a.stl"]}
        culprit = {"srdf": srdf, "stl": mesh}.get(target, path)
        contents[culprit] = data.draw(damaged(contents[culprit]), label="damage")
        if base != "one joint":
            del contents[srdf]
            srdf.unlink(missing_ok=True)
        for each, content in contents.items():
            each.write_bytes(content)
        try_loading(path, target in built)

    run()


def test_a_damaged_file_loads_or_is_refused(tmp_path):
    fuzz(30, tmp_path, {"one joint", "mimic", "mesh", "srdf", "stl"})


@pytest.mark.slow
def test_many_damaged_files_load_or_are_refused(tmp_path):
    fuzz(1000, tmp_path, {*NAMES, "srdf", "stl"})


FORMATS = ["test.urdf", "test.srdf", *GOOD]


def flip_bits(name: str, count: int, folder: Path, built: int) -> None:
    """Load a robot whose file ``name`` has one flipped bit, for ``count`` places in it; simulate
    every ``built``-th.
    """
    urdf = arm(name).encode() if name in GOOD else SOURCES["one joint"]
    content = {"test.urdf": urdf, "test.srdf": SRDF, **GOOD}[name]
    (folder / "test.urdf").write_bytes(urdf)
    for case, (place, bit) in enumerate(
        np.random.default_rng(0).integers(0, (len(content), 8), (count, 2))
    ):
        flipped = bytes([content[place] ^ 1 << bit])
        (folder / name).write_bytes(content[:place] + flipped + content[place + 1 :])
        try_loading(folder / "test.urdf", build=case % built == 0)


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_with_a_flipped_bit_loads_or_is_refused(name, tmp_path):
    flip_bits(name, 15, tmp_path, built=15)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_file_with_any_of_many_flipped_bits_loads_or_is_refused(name, tmp_path):
    flip_bits(name, 500, tmp_path, built=1)
