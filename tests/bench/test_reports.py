"""Runs of the benchmarks and of the slow tests report their results."""

import re
import tomllib
from types import SimpleNamespace

from scripts import ROOT, load_script


def recipe(target):
    """Return the lines of a target of the Makefile."""
    return re.search(rf"^{target}:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)[1]


def lines_of(comparisons, disabled):
    conftest, lines = load_script("conftest"), []
    found = [conftest.Comparison(*each) for each in comparisons]
    options = {"benchmark_disable": disabled, "benchmark_enable": False}
    config = SimpleNamespace(stash={conftest.COMPARISONS: found}, getoption=options.__getitem__)
    reporter = SimpleNamespace(section=lines.append, write_line=lines.append)
    conftest.pytest_terminal_summary(reporter, config)
    return lines


def test_the_last_lines_say_what_was_compared_with_what():
    ratios = [("panda", "closed loop", "tutorial", 3.1, None), ("panda", "closed loop", "bare engine", 0.92, 0.76)]
    title, head, *rows = lines_of(ratios, disabled=False)
    assert "compared" in title
    assert head == "panda: closed loop over"
    assert [row.split(maxsplit=1) for row in rows] == [["3.10", "tutorial"], ["0.92", "bare engine  (floor 0.76)"]]
    assert not lines_of(ratios, disabled=True)


def test_every_benchmark_is_part_of_the_tests():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "bench" in project["tool"]["pytest"]["ini_options"]["testpaths"]
    assert "--benchmark-disable" in recipe("test")


def test_the_slow_tests_print_each_result_as_it_comes():
    assert " -vv " in recipe("soak")


def test_slow_tests_have_no_limits_of_their_own():
    """The common limit ends a test that hangs, on a busy machine too."""
    own = re.compile(r"mark\.slow\)?\n@pytest\.mark\.timeout|mark\.timeout\(\d+\)\n@pytest\.mark\.slow")
    assert not [path.name for path in (ROOT / "tests").rglob("test_*.py") if own.search(path.read_text())]
