"""Fixtures of the benchmarks: the size of a run, and its last lines, which say what was compared with what.

With ``--benchmark-disable`` (``make test``) every case runs once on the tiny workload ``SMOKE``, the checks of
``make bench-check`` too, and no ratio has to keep its floor: such a run shows that the benchmarks work.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from pytest_benchmark.stats import Stats


class Size(NamedTuple):
    """Most that a run measures; a benchmark takes the lesser of this and its own."""

    envs: float = math.inf
    rows: float = math.inf
    """Envs of the law alone."""
    workers: float = math.inf
    ticks: float = math.inf
    rounds: float = math.inf
    seconds: float = math.inf
    """Of a measurement that repeats a call for so long."""
    floors: bool = True
    """Whether ratios have to keep their floors."""


SMOKE = Size(envs=2, rows=2048, workers=0, ticks=20, rounds=1, seconds=0.0, floors=False)


class Comparison(NamedTuple):
    """Speed of ``case`` over that of ``over``, and the least ratio that passes, if any."""

    setup: str
    case: str
    over: str
    ratio: float
    least: float | None


COMPARISONS = pytest.StashKey[list[Comparison]]()


def is_smoke(config: pytest.Config) -> bool:
    return bool(config.getoption("benchmark_disable") and not config.getoption("benchmark_enable"))


def pytest_configure(config: pytest.Config) -> None:
    config.stash[COMPARISONS] = []
    if config.args_source is pytest.Config.ArgsSource.TESTPATHS and not config.getoption("benchmark_only"):
        config.option.benchmark_disable = True  # "pytest" alone is a run of the tests


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Choose the checks, too, in a smoke run."""
    if is_smoke(config):
        for item in items:
            item.own_markers = [mark for mark in item.own_markers if mark.name != "check"]


@pytest.fixture(scope="session")
def most(pytestconfig: pytest.Config) -> Size:
    """Size of this run."""
    return SMOKE if is_smoke(pytestconfig) else Size()


@pytest.fixture
def benchmark(benchmark: Any) -> Any:
    """pytest-benchmark's fixture, whose ``pedantic`` also has the statistics of its only round in a smoke run."""
    if benchmark.disabled:
        stats, pedantic = Stats(), benchmark.pedantic

        def once(run: Callable[[], Any], **options: Any) -> Any:
            def timed() -> Any:
                began = time.perf_counter()
                result = run()
                stats.update(time.perf_counter() - began)
                return result

            return pedantic(timed, **options)

        benchmark.stats, benchmark.pedantic = SimpleNamespace(stats=stats), once
    return benchmark


@pytest.fixture
def report(benchmark: Any) -> Callable[[list[float]], None]:
    """Function that replaces the seconds of the rounds by these, per env step, so that OPS is env-steps per second."""

    def replace(seconds: list[float]) -> None:
        stats = benchmark.stats.stats
        stats.data[:] = seconds
        benchmark.extra_info["env_steps_per_second"] = round(1 / stats.median)

    return replace


@pytest.fixture
def compare(pytestconfig: pytest.Config, most: Size) -> Callable[..., None]:
    """Function that notes a comparison for the last lines, and fails where its ratio is below ``least``."""

    def note(setup: str, case: str, over: str, ratio: float, least: float | None = None) -> None:
        assert math.isfinite(ratio)
        assert ratio > 0
        pytestconfig.stash[COMPARISONS].append(Comparison(setup, case, over, ratio, least))
        if least is not None and most.floors:
            assert ratio >= least, f"{setup}: {case} over {over}: {ratio:.3f}, floor {least}"

    return note


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the comparisons."""
    found = config.stash[COMPARISONS]
    if is_smoke(config) or not found:
        return
    terminalreporter.section("compared: speed of the first over that of the others, in the same run")
    for setup, case in dict.fromkeys((each.setup, each.case) for each in found):
        terminalreporter.write_line(f"{setup}: {case} over")
        for each in found:
            if (each.setup, each.case) == (setup, case):
                floor = "" if each.least is None else f"  (floor {each.least:g})"
                terminalreporter.write_line(f"{each.ratio:10.2f}  {each.over}{floor}")
