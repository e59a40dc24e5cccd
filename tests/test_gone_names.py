"""Names of removed features stand in no page, docstring, message or help."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GONE = (
    # one a line, as a regular expression; sorted
    r"--duration\b",
    r"--search-seconds",
    r"batchpid parity",
    r"batchpid render",
    r"compare_engines",
    r"engine_differences",
    r"engine_parity",
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
