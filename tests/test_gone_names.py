"""Names of removed features stand in no page, docstring, message or help."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GONE = (
    # one a line, as a regular expression; sorted
    r"--project",
    r"--to (isaac_lab|maniskill|newton)",
    r"actuator_presets",
    r"control_toolbox\(",
    r"decoupling=",
    r"first_derivative",
    r"from_ros2_control",
    r"gain_units=.inertia",
    r"integrate_first",
    r"motors\.presets",
    r"osc_presets",
    r"per_inertia",
    r"presets\.simple_pid",
    r"to_c_project",
    r"to_isaac_lab",
    r"to_maniskill",
    r"to_newton",
    r"ts\.presets",
    r"weight_origin",
    r"--duration\b",
    r"--search-seconds",
    r"--variation",
    r"--within",
    r"ToolTuning",
    r"batchpid parity",
    r"batchpid render",
    r"batchpid tune --resume",
    r"compare_engines",
    r"engine_differences",
    r"engine_parity",
    r"tool_candidates",
    r"tool_search",
    r"tune_tool",
    r"usual_variation",
)
FILES = [
    path
    for pattern in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "Makefile", "pyproject.toml", "docs/*.md")
    for path in ROOT.glob(pattern)
] + [path for folder in ("batchpid", "sim", "bench", "examples") for path in (ROOT / folder).rglob("*.py")]


@pytest.mark.parametrize("name", GONE or [None])
def test_no_file_names_what_is_gone(name: str | None) -> None:
    pattern = re.compile(name) if name else None
    naming = [str(path.relative_to(ROOT)) for path in FILES if pattern and pattern.search(path.read_text())]
    assert not naming, f"{name!r} is gone, but these files name it: {naming}"
