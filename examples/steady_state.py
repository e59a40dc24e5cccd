"""Steady-state errors of PhysX's drive and of the PID, with and without compensation of gravity and
Coriolis forces.

    python examples/steady_state.py --picture steady-state.png

A drive's effort is proportional to its error, so it keeps an error against gravity; compensation
removes the load as far as the model is right. The integral of a PID removes the error without a
model.
"""

from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from batchpid.sim import Robot, Runner, plots

VARIANTS = (
    # control, compensate, label, colour, filled
    ("drive", "none", "drive (20, 5), no compensation", "#c2570c", True),
    ("drive", "gravity+coriolis", "drive (20, 5), compensated", "#c2570c", False),
    ("pid", "none", "PID, no compensation", "#15803d", True),
    ("pid", "gravity+coriolis", "PID, compensated", "#15803d", False),
)
FLOOR = 1e-6  # [rad]: resolution of float32 positions


def final_errors(robot: Robot, control: str, compensate: str, seconds: float) -> np.ndarray:
    """Return |setpoint - qpos| of every joint (dof,) after ``seconds`` at the tutorial's target."""
    gains = robot.tuned() if control == "pid" else None
    with Runner(
        robot,
        1,
        engine="sapien",
        control=control,
        compensate=compensate,
        workers=0,
        params=gains,
    ) as runner:
        ticks = round(seconds / (runner.substeps * runner.timestep))
        rollout = runner.rollout(np.broadcast_to(robot.target, (ticks, robot.dof)))
    return np.abs(rollout.qpos[-1, 0] - robot.target)


def draw(errors: dict[str, np.ndarray], names: list[str], title: str) -> Figure:
    """Return a figure with one row per joint and one mark per variant, on a logarithmic scale."""
    figure = Figure(figsize=(7.5, 0.34 * len(names) + 1.5), layout="constrained")
    axes = figure.add_subplot()
    rows = np.arange(len(names))
    axes.axvspan(FLOOR / 10, FLOOR, color="#f1f3f6", lw=0)
    axes.text(FLOOR * 0.63, -0.8, "0 ± 1e-6", ha="center", va="center", fontsize=7, color="#6b7280")
    shifts = np.linspace(-0.24, 0.24, len(VARIANTS))  # so that no mark hides another
    for (*_, label, colour, filled), error, shift in zip(
        VARIANTS, errors.values(), shifts, strict=True
    ):
        face = colour if filled else "white"
        at_least = np.maximum(error, FLOOR * 0.63)
        axes.plot(at_least, rows + shift, "o", ms=5, mec=colour, mfc=face, mew=1.2, label=label)
    axes.set_xscale("log")
    axes.set_xlim(FLOOR * 0.4, 2)
    axes.set_yticks(rows, names)
    axes.set_ylim(len(names) - 0.4, -1.1)
    axes.hlines(rows[1:] - 0.5, FLOOR * 0.4, 2, color="#eef0f3", lw=0.8, zorder=0)
    axes.set_xlabel("final error [rad]")
    axes.grid(axis="x", alpha=0.3)
    axes.tick_params(axis="y", length=0)
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.set_title(title, fontsize=10, loc="left")
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8.5)
    return figure


def main(
    robot: tyro.conf.Positional[str] = "panda",
    seconds: float = 12.0,
    picture: Path = Path("out/steady-state.png"),
) -> None:
    """Run the four variants, print their final errors and draw them.

    Args:
        robot: Bundled robot: panda or jaco2.
        seconds: Simulated time of each variant [s].
        picture: Picture to draw: .png or .svg.
    """
    loaded = Robot.load(robot)
    arm = [joint for joint, name in enumerate(loaded.joint_names) if "finger" not in name]
    names = [f"joint {joint + 1}" for joint in arm]
    errors = {}
    print(f"{'final error [rad]':32}", *(f"{name:>9}" for name in names))
    for control, compensate, label, *_ in VARIANTS:
        errors[label] = final_errors(loaded, control, compensate, seconds)[arm]
        print(f"{label:32}", *(f"{error:9.1e}" for error in errors[label]))
    title = (
        f"Steady-state error: {loaded.name}, {seconds:g} s after a step to the tutorial's target"
    )
    print("picture:", plots.save(draw(errors, names, title), picture))


if __name__ == "__main__":
    tyro.cli(main)
