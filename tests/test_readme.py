"""The README: short, with one picture and one program, and with figures that were measured."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_it_has_at_most_700_words():
    assert len(README.split()) <= 700


def test_it_has_one_picture_one_program_and_two_commands():
    assert len(re.findall(r"!\[", README)) == 1
    assert re.findall(r"^```(\w+)$", README, re.MULTILINE) == ["sh", "python", "sh"]
    assert all(
        len(block.splitlines()) == 1
        for block in re.findall(r"```sh\n(.*?)\n```", README, re.DOTALL)
    )


@pytest.mark.parametrize(
    ("label", "setup", "case"),
    [
        ('batchpid, `engine="mujoco"`', "panda-accurate", "closed loop, MuJoCo"),
        ("`mujoco.batch`, its own PID, without Coriolis compensation", "panda-accurate", "mujoco"),
        ('batchpid, SAPIEN, `physics="fast"`', "panda-fast", "closed loop"),
        ("batchpid, SAPIEN, its default solver", "panda-accurate", "closed loop"),
        ("SAPIEN's tutorial, one process per core", "panda-accurate", "tutorial, a process a core"),
        ("SAPIEN's tutorial in Gymnasium's vector env", "panda-accurate", "gymnasium, all envs"),
    ],
)
def test_its_speeds_are_those_of_the_measurements(label, setup, case):
    cases = json.loads((ROOT / "docs/performance.json").read_text())["cases"]
    assert f"\n| {label} | {cases[setup]['rates'][case] / 1e3:.0f} |\n" in README
