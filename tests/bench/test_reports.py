"""Runs of the benchmarks report their results."""

from types import SimpleNamespace

from scripts import load_script


def lines_of(comparisons, disabled):
    conftest, lines = load_script("conftest"), []
    options = {"benchmark_disable": disabled, "benchmark_enable": False}
    stash = {conftest.COMPARISONS: [conftest.Comparison(*row) for row in comparisons]}
    config = SimpleNamespace(stash=stash, getoption=options.__getitem__)
    reporter = SimpleNamespace(section=lines.append, write_line=lines.append)
    conftest.pytest_terminal_summary(reporter, config)
    return lines


def test_the_last_lines_say_what_was_compared_with_what():
    ratios = [
        ("panda", "closed loop", "tutorial", 3.1, None),
        ("panda", "closed loop", "bare engine", 0.92, 0.76),
    ]
    title, head, *rows = lines_of(ratios, disabled=False)
    assert "compared" in title
    assert head == "panda: closed loop over"
    assert [row.split(maxsplit=1) for row in rows] == [
        ["3.10", "tutorial"],
        ["0.92", "bare engine  (floor 0.76)"],
    ]
    assert not lines_of(ratios, disabled=True)
