"""The README: short, with one picture and one program, and with figures that were measured."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
TIMESTEP = 1 / 2000


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
    ("engine", "case", "rate"),
    [
        ("MuJoCo", "panda-accurate", "closed loop, MuJoCo"),
        ('SAPIEN, `physics="fast"`', "panda-fast", "closed loop"),
        ("SAPIEN, its default solver", "panda-accurate", "closed loop"),
    ],
)
def test_its_speeds_are_those_of_the_measurements(engine, case, rate):
    measured = json.loads((ROOT / "docs/performance.json").read_text())["cases"][case]["rates"][
        rate
    ]
    assert (
        f"\n| {engine} | {measured / 1e3:.0f} thousand | {measured * TIMESTEP / 64:.1f} |\n"
        in README
    )
