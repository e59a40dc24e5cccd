"""Damaged files of every kind: read with their present content, or refused by an error that names
the file.

Bytes, keys, values and lengths are changed at random. A file with the same content as the original
gives the same value. A file with other content gives another value or is refused, so that no part
of a file is ignored. A missing key has its default.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from option_values import ARM, MOTORS

import batchpid as bp
from batchpid.errors import BatchPIDError
from batchpid.sim import Robot
from batchpid.sim.identification import read_logs
from batchpid.sim.recording.setpoint_files import read_setpoints
from batchpid.sim.tuning.evaluation import load_randomization

pytestmark = pytest.mark.filterwarnings("ignore")  # warnings of unusual values
JOINTS = list(ARM.joint_names)
PARAMS = ARM.params(
    kp=[[40.0, 20.0], [30.0, 10.0]], ki=5.0, kd=2.0, effort_limit=87.0, anti_windup="conditional"
)
DRAWN = {
    "payload": {"uniform": [0.0, 0.3]},
    "params": {"kp": {"log_uniform": [0.5, 2.0], "operation": "scale"}},
}


class Kind(NamedTuple):
    """Kind of file, with a function that writes a good one and a function that reads one."""

    write: Callable[[Path], object]
    """Function that writes a good file."""
    read: Callable[[Path], object]
    """Function that returns the value of a file."""


def write_table(path, quantity="qpos"):
    """Write a CSV file of a slow motion: setpoints and another ``quantity`` of both joints."""
    time = 0.01 * np.arange(60)
    wave = ARM.start + 0.1 * np.sin(3 * time)[:, None]
    names = ["time", *(f"{each}:{joint}" for each in ("setpoint", quantity) for joint in JOINTS)]
    table = np.column_stack([time, wave, wave + 0.01])
    np.savetxt(path, table, "%.6g", ",", header=",".join(names), comments="")


KINDS = {
    "params.yaml": Kind(
        lambda path: bp.save_params(path, PARAMS, JOINTS), lambda path: bp.load_params(path, JOINTS)
    ),
    "motors.yaml": Kind(
        lambda path: bp.save_actuators(path, MOTORS, JOINTS),
        lambda path: bp.load_actuators(path, JOINTS),
    ),
    "drawn.yaml": Kind(
        lambda path: path.write_text(yaml.safe_dump(DRAWN)),
        lambda path: repr(load_randomization(path, ARM)),
    ),
    "log.csv": Kind(write_table, lambda path: read_logs(ARM, [path])),
    "motion.csv": Kind(
        lambda path: write_table(path, "setpoint_rate"),
        lambda path: read_setpoints(ARM, path, timestep=1e-3),
    ),
}


SNIPPETS = [
    b"",
    b"nan",
    b"inf",
    b"-1",
    b"1e999",
    b"0",
    b'"',
    b"'",
    b"{",
    b"]",
    b":",
    b",",
    b"\n",
    b"#",
    b"- a",
    b"*a",
]
SNIPPETS += [
    b"\0",
    b"\xff\xfe",
    b"9" * 400,
    b"[" * 2000,
    b"!!python/object/apply:os.getcwd []",
    b"<<",
    b"true",
]
LEAVES = [
    None,
    True,
    -1.0,
    0.7,
    3,
    float("nan"),
    float("inf"),
    1e300,
    10**400,
    "",
    "nan",
    "other",
    [],
    {},
    [[1.0]],
]
CELLS = ["", "nan", "inf", "-5", "0.123", "1e999", "x", "1 rad", '"', "time"]


def plain(value):
    """Return a value as nested dicts and lists of texts, with all digits of its numbers."""
    if isinstance(value, np.ndarray):
        return repr((str(value.dtype), value.shape, value.tolist()))
    if isinstance(value, Robot):
        return value.name
    if dataclasses.is_dataclass(value):
        parts = {each.name: plain(getattr(value, each.name)) for each in dataclasses.fields(value)}
        return {"type": type(value).__name__, **parts}
    if isinstance(value, int) and abs(value) < 2**53 and not isinstance(value, bool):
        return repr(float(value))
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    return [plain(each) for each in value] if isinstance(value, tuple | list) else repr(value)


def decoded(suffix, content):
    """Return the content of a file as a tree of mappings, lists, numbers and texts."""
    if suffix == ".csv":
        lines = [
            line
            for line in content.decode().splitlines()
            if line.strip() and not line.lstrip().startswith("#")
        ]
        return [[_number(cell.strip()) for cell in line.split(",")] for line in lines]
    return yaml.safe_load(content) if suffix == ".yaml" else json.loads(content)


def _number(cell):
    try:
        return float(cell)
    except ValueError:
        return cell


def encoded(suffix, tree):
    """Return the content of a file that holds ``tree``: the inverse of :func:`decoded`."""
    if suffix == ".csv":
        return "\n".join(",".join(map(str, row)) for row in tree).encode()
    return (
        yaml.safe_dump(tree, sort_keys=False) if suffix == ".yaml" else json.dumps(tree)
    ).encode()


@st.composite
def changed_bytes(draw, content):
    """Draw a copy of the content with a flipped bit, or a part replaced, repeated, removed or cut
    off.
    """
    start, length = draw(st.integers(0, len(content) - 1)), draw(st.integers(0, 30))
    before, part, after = (
        content[:start],
        content[start : start + length],
        content[start + length :],
    )
    match draw(st.sampled_from(["flip", "replace", "repeat", "remove", "cut"])):
        case "flip":
            return (
                before
                + bytes([content[start] ^ 1 << draw(st.integers(0, 7))])
                + content[start + 1 :]
            )
        case "replace":
            return before + draw(st.sampled_from(SNIPPETS)) + after
        case "repeat":
            return before + part + part + after
        case "remove":
            return before + after
        case _:
            return before


def holds(part, whole):
    """Return whether ``part`` equals ``whole`` except for missing keys."""
    if isinstance(part, dict) and isinstance(whole, dict):
        return part.keys() <= whole.keys() and all(
            holds(each, whole[key]) for key, each in part.items()
        )
    if isinstance(part, list) and isinstance(whole, list):
        return len(part) == len(whole) and all(map(holds, part, whole))
    return bool(part == whole)


@st.composite
def changed_tree(draw, tree, leaves):
    """Draw a copy of the tree with a changed key, value or length somewhere."""
    if not isinstance(tree, dict | list) or not tree:
        return draw(st.sampled_from(leaves))
    changed = tree.copy()
    at = draw(st.sampled_from([*tree]) if isinstance(tree, dict) else st.integers(0, len(tree) - 1))
    match draw(st.sampled_from(["inner", "inner", "inner", "remove", "repeat"])):
        case "inner":
            changed[at] = draw(changed_tree(tree[at], leaves))
        case "remove":
            del changed[at]
        case _:
            if isinstance(tree, dict):
                changed[draw(st.sampled_from([*tree, f"{at}x", 7]))] = changed.pop(at)
            else:
                changed.insert(at, tree[at])
    return changed


@pytest.fixture
def good(request, tmp_path):
    """Kind, path, content and value of a good file."""
    kind, path = KINDS[request.param], tmp_path / request.param
    kind.write(path)
    return kind, path, path.read_bytes(), plain(kind.read(path))


def repeats(here, there):
    """Return whether a table is another one with rows repeated, which a log leaves out with a
    warning.
    """
    return [row for at, row in enumerate(here) if at == 0 or row != here[at - 1]] == there


def check(good, content):
    """Check that a file with ``content`` is refused with its name in the error, or read with the
    right value.
    """
    kind, path, original, value = good
    path.write_bytes(content)
    try:
        here, there = (plain(decoded(path.suffix, each)) for each in (content, original))
        same, may_be = (
            here == there,
            holds(here, there) or (path.suffix == ".csv" and repeats(here, there)),
        )
    except Exception:  # no tree: the file must be refused
        same, may_be = False, False
    try:
        found = plain(kind.read(path))
    except BatchPIDError as error:
        assert path.name in str(error)  # noqa: PT017
    except FileNotFoundError as error:
        assert error.filename not in (None, str(path))  # of another file, whose name is in this one  # noqa: PT017
    else:
        assert same or found != value or may_be
        assert found == value or not same
    finally:
        path.write_bytes(original)


of_all_kinds = pytest.mark.parametrize("good", list(KINDS), indirect=True)
EXAMPLES = {
    "derandomize": True,
    "phases": [Phase.generate],
    "report_multiple_bugs": False,
    "suppress_health_check": [HealthCheck.function_scoped_fixture],
}


@of_all_kinds
@settings(max_examples=25, **EXAMPLES)
@given(st.data())
def test_bytes(good, data):
    check(good, data.draw(changed_bytes(good[2])))


@st.composite
def encoded_changes(draw, suffix, content):
    """Draw the content of a file with a changed key, value or length."""
    leaves = CELLS if suffix == ".csv" else LEAVES
    return encoded(suffix, draw(changed_tree(decoded(suffix, content), leaves)))


@of_all_kinds
@settings(max_examples=30, **EXAMPLES)
@given(st.data())
def test_keys_values_and_lengths(good, data):
    check(good, data.draw(encoded_changes(good[1].suffix, good[2])))


@pytest.mark.slow
@of_all_kinds
@settings(max_examples=int(os.environ.get("BATCHPID_SOAK_EXAMPLES", "500")), **EXAMPLES)
@given(st.data())
def test_many_changes(good, data):
    content = good[2]
    check(good, data.draw(changed_bytes(content) | encoded_changes(good[1].suffix, content)))
