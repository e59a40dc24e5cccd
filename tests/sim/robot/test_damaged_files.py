"""A damaged URDF or .srdf loads or is refused by an error of ours, within seconds and a bounded
memory.
"""

import resource
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mesh_files import GOOD, arm
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
}
SOURCES |= {name: arm(name).encode() for name in GOOD}
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
def damaged(draw, data):
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


def try_loading(path, build):
    """Load a robot and ``build`` a scene of it: an error is one of ours, and the memory is bounded."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        loaded = Robot.load(path)
        if build:
            with Runner(loaded, 1, workers=0, params=loaded.params(kp=1.0), substeps=1) as runner:
                runner.step(loaded.start)
    except RobotError:
        pass
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kB


def fuzz(count, folder, built):
    path, srdf = (folder / name for name in ("test.urdf", "test.srdf"))

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=st.data())
    def run(data):
        base = data.draw(st.sampled_from(NAMES), label="robot")
        contents = {path: SOURCES[base]}
        if base == "one joint":
            contents[srdf] = SRDF
        elif base in GOOD:
            contents[folder / base] = GOOD[base]
        culprit = data.draw(st.sampled_from([*contents]), label="damaged file")
        contents[culprit] = data.draw(damaged(contents[culprit]), label="damage")
        srdf.unlink(missing_ok=True)
        for each, content in contents.items():
            each.write_bytes(content)
        try_loading(path, base in built)

    run()


def test_a_damaged_file_loads_or_is_refused(tmp_path):
    fuzz(60, tmp_path, {"one joint", "mimic", "a.stl"})


@pytest.mark.slow
def test_many_damaged_files_load_or_are_refused(tmp_path):
    fuzz(2000, tmp_path, NAMES)
