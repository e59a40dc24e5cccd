"""Draw the picture of docs/performance.md, and write its first tables: ``python bench/draw.py
[FOLDER]``.

FOLDER holds the measurements of ``make figures``; they go into docs/performance.json first. Without
it everything is drawn from that file.
"""

from __future__ import annotations

import json
import re
import textwrap
from dataclasses import dataclass
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
OURS, OTHER = "#2f6f9f", "#c9b48a"
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
}


@dataclass(frozen=True)
class Options:
    """Draw the picture of docs/performance.md, and write its first tables."""

    folder: tyro.conf.Positional[Path | None] = None
    """Folder of new measurements; default: none."""
    docs: Path = DOCS
    """Folder of performance.md."""


def main(options: Options) -> None:
    """Merge new figures, if any; draw the picture; write the tables."""
    docs = options.docs
    path = docs / "performance.json"
    figures = json.loads(path.read_text()) if path.is_file() else {}
    if options.folder is not None:
        for name in SETUPS:
            measurement = options.folder / f"{name}.json"
            if measurement.is_file():
                case = json.loads(measurement.read_text())
                figures["machine"] = case.pop("machine")
                figures.setdefault("cases", {})[name] = case
        write_atomically(path, json.dumps(figures, indent=1) + "\n")
    save(draw_speed(figures), docs / "images" / "performance.png")
    page = docs / "performance.md"
    text = page.read_text()
    tables = {
        "machine": machine(figures["machine"]),
        "cases": cases_table(figures["cases"]),
        "phases": phases_table(figures["cases"]),
    }
    for name, table in tables.items():
        marked = re.compile(rf"(<!-- {name}: [^>]*-->\n).*?(<!-- end -->)", re.DOTALL)
        text = marked.sub(lambda match, table=table: f"{match[1]}{table}\n{match[2]}", text)
    write_atomically(page, text)


def draw_speed(figures: dict[str, Any]) -> Figure:
    """Draw the speed of the panda in each case, and the phases of a step."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    draw_cases(left, figures["cases"])
    draw_phases(right, figures["cases"])
    machine = figures["machine"]
    figure.suptitle(
        "64 Pandas under PID, gravity and Coriolis compensation at every sim step of 0.5 ms, on "
        f"{machine['cores']} cores ({machine['processor']}, SAPIEN {machine['sapien']})",
        fontsize=10,
    )
    return figure


def draw_cases(axes: Axes, cases: dict[str, Any]) -> None:
    """Draw the speed of the cases of :data:`DRAWN`, the fastest first."""
    rates = [(cases[name]["rates"][case] / 1e3, label) for label, (name, case) in DRAWN.items()]
    for row, (rate, label) in enumerate(sorted(rates)):
        axes.barh(
            row, rate, height=0.7, color=OURS if label.startswith("batchpid") else OTHER, lw=0
        )
        axes.text(rate, row, f" {rate:.0f}", va="center", fontsize=8.5)
    axes.set_yticks(range(len(rates)), [label for _, label in sorted(rates)])
    axes.set_title(
        "thousand sim steps per second, of all robots together", fontsize=9.5, loc="left"
    )
    tidy(axes, "x")


def draw_phases(axes: Axes, cases: dict[str, Any]) -> None:
    """Draw the microseconds per env step of each phase, stacked."""
    for row, (name, label) in enumerate(reversed(SETUPS.items())):
        left = 0.0
        for phase, (colour, meaning) in PHASES.items():
            spent = cases[name]["phases"][phase]
            axes.barh(
                row,
                spent,
                left=left,
                height=0.6,
                color=colour,
                lw=0,
                label=meaning if row == 0 else None,
            )
            left += spent
        axes.text(0.3, row + 0.42, label, fontsize=8.5, va="center")
    axes.set_yticks([])
    axes.set_ylim(-1.6, len(SETUPS) - 0.3)
    axes.legend(loc="lower left", ncols=2, fontsize=8, frameon=False)
    axes.set_title("SAPIEN: µs per sim step", fontsize=9.5, loc="left")
    tidy(axes, "x")


def tidy(axes: Axes, grid: str) -> None:
    """Style ``axes``: small ticks, a faint grid behind, no frame on top and at the right."""
    axes.tick_params(labelsize=8.5)
    axes.grid(axis=grid, color="#e6e6e6", lw=0.6)  # type: ignore[arg-type]
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def machine(about: dict[str, Any]) -> str:
    """Return the machine and the versions."""
    packages = ", ".join(
        f"{name} {about[name]}"
        for name in ("sapien", "numpy", "mujoco", "gymnasium")
        if name in about
    )
    text = f"Measured on {about['cores']} cores of {about['processor']}, Python {about['python']},"
    return textwrap.fill(f"{text} {packages}.", 120)


def cases_table(cases: dict[str, Any]) -> str:
    """Return the table of rates, and of the closed loop over each, also per process where that is
    another ratio.
    """

    def cell(figures: dict[str, Any], case: str) -> str:
        if case not in figures["rates"]:
            return ""
        ratio = figures["ratios"][case]
        alike = figures.get("per_process", {}).get(case, ratio)
        both = f"{ratio:.2f}" if abs(alike - ratio) < 0.01 else f"{ratio:.2f}; {alike:.2f}"
        return f"{figures['rates'][case] / 1e3:.1f} ({both})"

    rows = [
        [case, *(cell(cases[name], case) for name in SETUPS)]
        for case in cases["panda-accurate"]["rates"]
    ]
    return markdown(["thousand env-steps/s (closed loop / case)", *SETUPS.values()], rows)


def phases_table(cases: dict[str, Any]) -> str:
    """Return the table of microseconds per env step of each phase."""
    rows = [
        [label, *(f"{cases[name]['phases'][phase]:.2f}" for phase in PHASES)]
        for name, label in SETUPS.items()
    ]
    return markdown(["µs per env step in a worker", *PHASES], rows)


def markdown(headers: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table, without blanks that align its columns."""
    lines = [headers, ["---"] * len(headers), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    main(tyro.cli(Options))
