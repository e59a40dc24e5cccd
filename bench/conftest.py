"""Fixtures of the benchmarks: the size of a run, and the summary of comparisons at its end.

With ``--benchmark-disable`` (``make test``) the benchmarks, and the checks of ``make bench-check``,
run once on the tiny workload ``SMOKE``, and floors of ratios are ignored: such a smoke run shows
that the benchmarks work. Of a benchmark with several robots, presets or numbers of envs it runs the
panda, "accurate", and the largest number.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
from pytest_benchmark.stats import Stats


class Size(NamedTuple):
    """Upper bounds on the workload of a run; a benchmark uses the smaller of the bound and its own
    value.
    """

    envs: float = math.inf
    rows: float = math.inf
    """Number of envs in benchmarks of the law alone."""
    workers: float = math.inf
    ticks: float = math.inf
    poses: float = math.inf
    rounds: float = math.inf
    seconds: float = math.inf
    """Duration of a measurement that repeats a call [s]."""
    floors: bool = True
    """Whether ratios have to keep their floors."""


SMOKE = Size(envs=2, rows=2048, workers=0, ticks=20, poses=1, rounds=1, seconds=0.0, floors=False)


class Comparison(NamedTuple):
    """Ratio of the speeds of ``case`` and ``over``, and its floor, if it has one."""

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
    if is_smoke(config):
        os.environ["NUMBA_DISABLE_JIT"] = "1"  # compilation would take most of the time
    if config.args_source is pytest.Config.ArgsSource.TESTPATHS and not config.getoption(
        "benchmark_only"
    ):
        config.option.benchmark_disable = True  # "pytest" alone is a run of the tests


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Select the tests marked ``check``, too, in a smoke run, and one workload of each
    benchmark.
    """
    if not is_smoke(config):
        return
    benchmarks = [item for item in items if item.path.is_relative_to(Path(__file__).parent)]
    largest: dict[str, int] = {}
    for item in benchmarks:
        item.own_markers = [mark for mark in item.own_markers if mark.name != "check"]
        name, _, workload = item.name.partition("[")
        largest[name] = max(largest.get(name, 0), num_envs(item))
        if "jaco2" in workload or "fast" in workload:
            items.remove(item)
    for item in benchmarks:
        if item in items and num_envs(item) < largest[item.name.partition("[")[0]]:
            items.remove(item)


def num_envs(item: pytest.Item) -> int:
    """Return the number of envs in the name of an item, or 0."""
    parameters: dict[str, Any] = item.callspec.params if hasattr(item, "callspec") else {}
    return int(parameters.get("num_envs", 0))


@pytest.fixture(scope="session")
def most(pytestconfig: pytest.Config) -> Size:
    """Size of this run."""
    return SMOKE if is_smoke(pytestconfig) else Size()


@pytest.fixture(scope="module")
def quick_smoke(most: Size) -> Iterator[None]:
    """Make JAX compile with few optimisations in a smoke run."""
    if most.floors:
        yield
        return
    jax = pytest.importorskip("jax")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
    jax.clear_caches()


@pytest.fixture
def benchmark(benchmark: Any) -> Any:
    """pytest-benchmark's fixture; in a smoke run, its ``pedantic`` records the time of the only
    round, too.
    """
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
    """Function that replaces the times of the rounds by times per env step [s]: OPS becomes
    env-steps per second.
    """

    def replace(seconds: list[float]) -> None:
        stats = benchmark.stats.stats
        stats.data[:] = seconds
        benchmark.extra_info["env_steps_per_second"] = round(1 / stats.median)

    return replace


@pytest.fixture
def compare(pytestconfig: pytest.Config, most: Size) -> Callable[..., None]:
    """Function that records a comparison for the summary, and fails if its ratio is below
    ``least``.
    """

    def note(setup: str, case: str, over: str, ratio: float, least: float | None = None) -> None:
        assert math.isfinite(ratio)
        assert ratio > 0
        pytestconfig.stash[COMPARISONS].append(Comparison(setup, case, over, ratio, least))
        if least is not None and most.floors:
            assert ratio >= least, f"{setup}: {case} over {over}: {ratio:.3f}, floor {least}"

    return note


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the comparisons."""
    found = config.stash[COMPARISONS]
    if is_smoke(config) or not found:
        return
    terminalreporter.section(
        "compared: speed of the first over that of the others, in the same run"
    )
    for setup, case in dict.fromkeys((each.setup, each.case) for each in found):
        terminalreporter.write_line(f"{setup}: {case} over")
        for each in found:
            if (each.setup, each.case) == (setup, case):
                floor = "" if each.least is None else f"  (floor {each.least:g})"
                terminalreporter.write_line(f"{each.ratio:10.2f}  {each.over}{floor}")
