"""Draw the figures of docs/performance.md, and write its tables: ``python bench/draw.py [FOLDER]``.

FOLDER holds the measurements of ``make figures``; they go into docs/performance.json first. Without it everything is
drawn from that file. It makes every table and picture of one page.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from batchpid.io.files import write_atomically
from batchpid.sim.plots.figures import save

DOCS = Path(__file__).resolve().parent.parent / "docs"
SETUPS = {
    "panda-accurate": "panda, accurate",
    "panda-fast": "panda, fast",
    "jaco2-accurate": "jaco2, accurate",
    "jaco2-fast": "jaco2, fast",
}
OURS, OTHER, FAST, FREE = "#2f6f9f", "#c9b48a", "#e08a3c", "#5aa469"
DRAWN = {
    # label in the picture: (setup, case); the table has all cases
    "batchpid, MuJoCo": ("panda-accurate", "closed loop, MuJoCo"),
    "MuJoCo alone, with its own PID, two threads": ("panda-accurate", "mujoco"),
    'batchpid, SAPIEN, physics="fast"': ("panda-fast", "closed loop"),
    "SAPIEN without control, robot by robot": ("panda-accurate", "bare engine, robot by robot"),
    "batchpid, SAPIEN": ("panda-accurate", "closed loop"),
    "SAPIEN's tutorial, two processes": ("panda-accurate", "tutorial, a process a core"),
    "the tutorial under Gymnasium's vector env": ("panda-accurate", "gymnasium, all envs"),
    "SAPIEN's tutorial, one process": ("panda-accurate", "tutorial"),
}
PHASES = {
    # phase: (colour, meaning)
    "step": ("#8a8a8a", "physics"),
    "passive": ("#2f6f9f", "gravity, Coriolis"),
    "control": ("#e08a3c", "control"),
    "read": ("#5aa469", "reading"),
    "write": ("#b45f82", "writing"),
    "waiting": ("#d9d9d9", "waiting"),
}
PRESETS = ("accurate", "fast")
"""Presets in the table of their errors."""
MOTIONS = {
    "tutorial": "the tutorial's",
    "start pose held": "holding the start pose, gripper closed",
    "median": "seeded moves and these: median",
    "slowest": "the slowest of them",
}
SCALING = {
    # group of the benchmark: (its parameter, label of the axis, value of the case that all groups have)
    "envs (2 workers)": ("num_envs", "envs (2 workers, 20 sim steps in a tick)", 64),
    "workers (64 envs)": ("workers", "workers (64 envs; 0: in the caller's process)", 2),
    "substeps (64 envs, 2 workers)": ("substeps", "sim steps in a tick (64 envs, 2 workers)", 20),
}
RESOURCES = {
    # name in extra_info: (meaning, format)
    "MB_per_env": ("memory of one env more (64 to 1024 envs)", "{:.2f} MB"),
    "build_ms_per_env": ("building one env more (64 to 1024 envs, two workers)", "{:.2f} ms"),
    "start_seconds": ("from `Runner(...)` to the first step, 64 envs", "{:.2f} s"),
    "cost_2048_over_64": ("cost of an env step at 2048 envs over that at 64", "{:.2f}"),
    "us_over_work": ("a tick of one sim step beyond the work of the slower worker, 64 envs", "{:.0f} µs"),
}


@dataclass(frozen=True)
class Options:
    """Draw the figures of docs/performance.md, and write its tables."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of new measurements; default: none."""
    docs: Path = DOCS
    """Folder of performance.md."""


def main(options: Options) -> None:
    """Merge new figures, if any; draw the pictures; write the tables."""
    docs = options.docs
    path = docs / "performance.json"
    figures = json.loads(path.read_text()) if path.is_file() else {}
    if options.folder is not None:
        figures |= gather(options.folder, figures)
        write_atomically(path, json.dumps(figures, indent=1) + "\n")
    save(draw_speed(figures), docs / "images" / "performance.png")
    save(draw_accuracy(figures["accuracy"]), docs / "images" / "accuracy.png")
    page = docs / "performance.md"
    text = page.read_text()
    for name, table in tables(figures).items():
        marked = re.compile(rf"(<!-- {name}: [^>]*-->\n).*?(<!-- end -->)", re.DOTALL)
        text = marked.sub(lambda match, table=table: f"{match[1]}{table}\n{match[2]}", text)
    write_atomically(page, text)


# -- figures -----------------------------------------------------------------------------------------------------


def gather(folder: Path, old: dict[str, Any]) -> dict[str, Any]:
    """Return the figures of the files in ``folder``; the "cases" that it lacks are kept from ``old``."""
    new: dict[str, Any] = {"cases": dict(old.get("cases", {}))}
    for name in SETUPS:
        if (path := folder / f"{name}.json").is_file():
            measured = json.loads(path.read_text())
            new["machine"] = measured.pop("machine")
            new["cases"][name] = measured
    if (path := folder / "pytest.json").is_file():
        benchmarks = json.loads(path.read_text())["benchmarks"]
        new["scaling"] = {
            group: {
                str(row["params"][parameter]): row["extra_info"]["env_steps_per_second"]
                for row in benchmarks
                if row["group"] == group
            }
            for group, (parameter, *_) in SCALING.items()
        }
        new["resources"] = {}
        for row in benchmarks:
            if row["group"] == "resources":
                robot = new["resources"].setdefault(row["params"]["workload"], {})
                robot |= {key: value for key, value in row["extra_info"].items() if key in RESOURCES}
        new["few"] = {}
        for row in benchmarks:
            if "over_tutorial" in row["extra_info"]:
                case = f"{row['params']['name']}, {row['params']['physics']}"
                new["few"].setdefault(case, {})[str(row["params"]["num_envs"])] = row["extra_info"]["over_tutorial"]
    if (path := folder / "motions.json").is_file():
        new["motions"] = json.loads(path.read_text())
    if (path := folder / "accuracy.json").is_file():
        new["accuracy"] = json.loads(path.read_text())["accuracy"]
    return new


# -- pictures ----------------------------------------------------------------------------------------------------


def draw_speed(figures: dict[str, Any]) -> Figure:
    """Draw the speed of the panda in each case, the phases of a step, and the scaling."""
    figure = Figure(figsize=(11, 7), layout="constrained")
    grid = figure.add_gridspec(2, 6, height_ratios=(1.2, 1))
    draw_cases(figure.add_subplot(grid[0, :4]), figures["cases"])
    draw_phases(figure.add_subplot(grid[0, 4:]), figures["cases"])
    machine = figures["machine"]
    for column, (group, (_, label, shared)) in enumerate(SCALING.items()):
        axes = figure.add_subplot(grid[1, 2 * column : 2 * column + 2])
        rates = {int(at): rate for at, rate in figures["scaling"][group].items()}
        if group.startswith("workers"):  # more workers than cores wait for each other
            rates = {at: rate for at, rate in rates.items() if at <= machine["cores"]}
        draw_scaling(axes, rates, label, shared)
    figure.suptitle(
        f"64 Pandas under PID, gravity and Coriolis compensation at every sim step of 0.5 ms, on "
        f"{machine['cores']} cores ({machine['processor']}, SAPIEN {machine['sapien']})",
        fontsize=10,
    )
    return figure


def draw_cases(axes: Axes, cases: dict[str, Any]) -> None:
    """Draw the speed of the cases of :data:`DRAWN`, the fastest first."""
    rates = [(cases[name]["rates"][case] / 1e3, label) for label, (name, case) in DRAWN.items()]
    for row, (rate, label) in enumerate(sorted(rates)):
        axes.barh(row, rate, height=0.7, color=OURS if label.startswith("batchpid") else OTHER, lw=0)
        axes.text(rate, row, f" {rate:.0f}", va="center", fontsize=8.5)
    axes.set_yticks(range(len(rates)), [label for _, label in sorted(rates)])
    axes.set_title("thousand sim steps per second, of all robots together", fontsize=9.5, loc="left")
    tidy(axes, "x")


def draw_phases(axes: Axes, cases: dict[str, Any]) -> None:
    """Draw the microseconds per env step of each phase, stacked."""
    for row, (name, label) in enumerate(reversed(SETUPS.items())):
        left = 0.0
        for phase, (colour, meaning) in PHASES.items():
            spent = cases[name]["phases"][phase]
            axes.barh(row, spent, left=left, height=0.6, color=colour, lw=0, label=meaning if row == 0 else None)
            left += spent
        axes.text(0.3, row + 0.42, label, fontsize=8.5, va="center")
    axes.set_yticks([])
    axes.set_ylim(-1.6, len(SETUPS) - 0.3)
    axes.legend(loc="lower left", ncols=2, fontsize=8, frameon=False)
    axes.set_title("SAPIEN: µs per sim step", fontsize=9.5, loc="left")
    tidy(axes, "x")


def draw_scaling(axes: Axes, rates: dict[int, float], label: str, shared: int) -> None:
    """Draw the speed over a parameter, as a multiple of the speed at ``shared``, the case that all curves have."""
    if max(rates) > 10:
        axes.set_xscale("log", base=2)
    axes.set_xticks(list(rates), [str(at) for at in rates])
    axes.minorticks_off()
    axes.plot(list(rates), [rate / rates[shared] for rate in rates.values()], "o-", color=OURS, ms=5, lw=1.6)
    axes.plot(shared, 1, "o", color=FAST, ms=8)
    axes.set_ylim(0, 1.3)
    axes.set_xlabel(label, fontsize=9)
    axes.set_ylabel("speed (orange: 1)", fontsize=9)
    tidy(axes, "y")


def draw_accuracy(rows: list[dict[str, Any]]) -> Figure:
    """Draw the largest error of each preset, by robot, kind of motion and reference."""
    robots = list(dict.fromkeys(row["robot"] for row in rows))
    kinds = list(dict.fromkeys((row["motion"], row["reference"]) for row in rows))[::-1]
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    panels = figure.subplots(1, len(robots), sharex=True, sharey=True, squeeze=False)[0]
    for row in rows:
        axes, preset = panels[robots.index(row["robot"])], PRESETS.index(row["physics"])
        place = kinds.index((row["motion"], row["reference"])) - 0.22 * (preset - 1)
        axes.plot(row["max"], place, "o", color=(OURS, FAST)[preset], ms=8, label=row["physics"])
    for robot, axes in zip(robots, panels, strict=True):
        axes.set_xscale("log")
        axes.set_yticks(range(len(kinds)), [f"{motion}, against {reference}" for motion, reference in kinds])
        axes.set_title(robot, fontsize=10, loc="left")
        axes.set_xlabel("largest error of a joint [rad]", fontsize=9)
        tidy(axes, "x")
    handles, labels = panels[0].get_legend_handles_labels()
    entries = dict(zip(labels, handles, strict=True))
    figure.legend(entries.values(), entries, loc="outside upper right", ncols=3, fontsize=9, frameon=False)
    return figure


def tidy(axes: Axes, grid: str) -> None:
    """Style ``axes``: small ticks, a faint grid behind, no frame on top and at the right."""
    axes.tick_params(labelsize=8.5)
    axes.grid(axis=grid, color="#e6e6e6", lw=0.6)  # type: ignore[arg-type]
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


# -- tables ------------------------------------------------------------------------------------------------------


def tables(figures: dict[str, Any]) -> dict[str, str]:
    """Return the Markdown of every table of the page, by its marker."""
    return {
        "machine": machine(figures["machine"]),
        "cases": cases_table(figures["cases"]),
        "phases": phases_table(figures["cases"]),
        "presets": presets_table(figures),
        "resources": resources_table(figures["resources"]),
        **({"motions": motions_table(figures["motions"])} if "motions" in figures else {}),
        **({"few": few_table(figures["few"])} if "few" in figures else {}),
    }


def machine(about: dict[str, Any]) -> str:
    """Return the machine and the versions, in a line."""
    packages = ", ".join(
        f"{name} {about[name]}" for name in ("sapien", "numpy", "mujoco", "gymnasium") if name in about
    )
    return f"Measured on {about['cores']} cores of {about['processor']}, Python {about['python']}, {packages}."


def cases_table(cases: dict[str, Any]) -> str:
    """Return the table of rates, and of the closed loop over each, also per process where that is another ratio."""

    def cell(figures: dict[str, Any], case: str) -> str:
        if case not in figures["rates"]:
            return ""
        ratio = figures["ratios"][case]
        alike = figures.get("per_process", {}).get(case, ratio)
        both = f"{ratio:.2f}" if abs(alike - ratio) < 0.01 else f"{ratio:.2f}; {alike:.2f} per process"
        return f"{figures['rates'][case] / 1e3:.1f} ({both})"

    rows = [[case, *(cell(cases[name], case) for name in SETUPS)] for case in cases["panda-accurate"]["rates"]]
    return markdown(["thousand env-steps/s (closed loop / case)", *SETUPS.values()], rows)


def phases_table(cases: dict[str, Any]) -> str:
    """Return the table of microseconds per env step of each phase."""
    rows = [[label, *(f"{cases[name]['phases'][phase]:.2f}" for phase in PHASES)] for name, label in SETUPS.items()]
    return markdown(["µs per env step in a worker", *PHASES], rows)


def presets_table(figures: dict[str, Any]) -> str:
    """Return the table of cost and errors of each preset."""
    rows = []
    measured, cases = {(row["robot"], row["physics"]) for row in figures["accuracy"]}, figures["cases"]
    robots = dict.fromkeys(name.split("-")[0] for name in SETUPS)
    for robot, physics in [both for both in product(robots, PRESETS) if both in measured]:
        phases = cases[f"{robot}-{physics}"]["phases"]
        all_work = sum(spent for phase, spent in phases.items() if phase != "waiting")
        cost = f"{phases['step']:.1f} / {all_work:.1f}"
        first = [f"{robot}, {physics}", cost]
        for row in figures["accuracy"]:
            if (row["robot"], row["physics"]) == (robot, physics):
                errors = [f"{row[kind]:.1e}" for kind in ("max", "rms")]
                rows.append([*first, row["motion"], row["reference"], *errors])
                first = ["", ""]
    headers = ["", "µs per env step: engine / all", "motion", "against", "max [rad]", "RMS [rad]"]
    return markdown(headers, rows)


def motions_table(measured: dict[str, Any]) -> str:
    """Return the table of the speed over the tutorial's loop, by motion, one process each."""
    columns = {
        f"{robot}, {variant}": found
        for robot, variants in measured["motions"].items()
        for variant, found in variants.items()
    }
    rows = [
        [
            f"{measured['moves']} {label}" if motion == "median" else label,
            *(f"{found[motion]:.1f}" for found in columns.values()),
        ]
        for motion, label in MOTIONS.items()
    ]
    return markdown(["times as fast as the tutorial's loop", *columns], rows)


def few_table(few: dict[str, dict[str, float]]) -> str:
    """Return the table of the speed of few robots over the tutorial's loop, both in the caller's process."""
    counts = list(next(iter(few.values())))
    rows = [[case, *(f"{ratios[count]:.2f}" for count in counts)] for case, ratios in few.items()]
    headers = [f"{count} robot{'s' if count != '1' else ''}" for count in counts]
    return markdown(["times as fast as the tutorial's loop", *headers], rows)


def resources_table(resources: dict[str, dict[str, float]]) -> str:
    """Return the table of memory and of the times to build and to start."""
    rows = [
        [meaning, *(style.format(robot[name]) for robot in resources.values())]
        for name, (meaning, style) in RESOURCES.items()
    ]
    return markdown(["", *resources], rows)


def markdown(headers: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    from tabulate import tabulate

    return str(tabulate(rows, headers, tablefmt="github", disable_numparse=True))


if __name__ == "__main__":
    main(tyro.cli(Options))
