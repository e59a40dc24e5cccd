"""What error stays: PhysX's drive and the PID, each with and without compensation of gravity and Coriolis forces.

    python examples/steady_state.py --out steady-state.png

A drive pushes back only where there is an error, so against gravity it keeps one; compensation takes the load off it,
as far as the model is right. The integral of a PID finds the load by itself.
"""

from pathlib import Path

import matplotlib
import numpy as np
import tyro

import batchpid as bp
from sim import Robot, Runner

matplotlib.use("Agg")
from matplotlib import pyplot as plt

VARIANTS = (
    # control, compensate, label, colour
    ("drive", "none", "drive (20, 5), no compensation", "#d97706"),
    ("drive", "gravity+coriolis", "drive (20, 5), compensated", "#fbbf24"),
    ("pid", "none", "PID, no compensation", "#15803d"),
    ("pid", "gravity+coriolis", "PID, compensated", "#86c99a"),
)
FLOOR = 1e-6  # [rad]: below it the last bits of float32 positions speak


def final_errors(robot: Robot, control: str, compensate: str, seconds: float) -> np.ndarray:
    """Return |setpoint - qpos| of every joint (dof,) after ``seconds`` at the tutorial's target."""
    params = bp.design_gains(robot) if control == "pid" else None
    with Runner(robot, 1, params=params, control=control, compensate=compensate, workers=0) as runner:
        target = robot.settings.target
        for _ in range(round(seconds / (runner.substeps * runner.timestep))):
            obs = runner.step(target)
    return np.abs(obs.qpos[0] - target)


def main(robot: str = "panda", seconds: float = 12.0, out: Path = Path("out/steady-state.png")) -> None:
    """Run the four, print the errors, and draw them."""
    loaded = Robot.load(robot)
    arm = [joint for joint in range(loaded.dof) if "finger" not in loaded.joint_names[joint]]
    names = [f"joint {joint + 1}" for joint in arm]
    figure, axes = plt.subplots(figsize=(9, 4), layout="constrained")
    print(f"{'final error [rad]':32}", *(f"{name:>9}" for name in names))
    for place, (control, compensate, label, colour) in enumerate(VARIANTS):
        errors = final_errors(loaded, control, compensate, seconds)[arm]
        print(f"{label:32}", *(f"{error:9.1e}" for error in errors))
        axes.bar(
            np.arange(len(arm)) + 0.2 * (place - 1.5),
            np.maximum(errors, FLOOR),
            0.2,
            color=colour,
            label=label,
        )
    axes.set_yscale("log")
    axes.set_ylim(FLOOR, 2)
    axes.set_xticks(range(len(arm)), names)
    axes.set_ylabel("final error [rad]")
    axes.set_title(f"{loaded.name} at the tutorial's target, after {seconds:g} s")
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)
    print("picture:", out)


if __name__ == "__main__":
    tyro.cli(main)
