"""Film of four robots under two sets of gains, with the response of one joint: ``python bench/film.py``.

It draws docs/images/two-gains.gif, the picture of the README, without a render device. The gains are from
docs/tutorial.md: designed, and chosen by hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from batchpid.sim import Robot, Rollout, Runner
from batchpid.sim.view.painter import Triangles, paint

PICTURE = Path(__file__).resolve().parent.parent / "docs" / "images" / "two-gains.gif"
GOAL = (0.5, 0.6, -0.5, -1.5, 0.5, 1.0)
"""Setpoints of the first six joints [rad], as in docs/tutorial.md."""
BY_HAND = {"kp": 100, "ki": 0, "kd": 2}
JOINT = 1
"""Joint of the response."""
COLOURS = {"designed gains": "#2f6f9f", "gains by hand": "#c2452d"}
SPACING = 1.05
"""Distance of the robots in the picture [m]. Each has its own scene; they are drawn side by side."""
CAMERA = np.array([1.0, 0.45, 0.4]) / np.linalg.norm([1.0, 0.45, 0.4])
"""Direction from the robots to the camera."""
RIGHT = np.cross([0.0, 0.0, 1.0], CAMERA) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], CAMERA))


@dataclass(frozen=True)
class Options:
    """Draw the film of the README."""

    out: Path = PICTURE
    """File of the film, a GIF."""
    seconds: float = 2.0
    """Length [s]."""
    interval: float = 0.05
    """Time between two pictures [s]."""


def simulate(robot: Robot, seconds: float, num_envs: int = 4) -> dict[str, Rollout]:
    """Return the motion of ``num_envs`` robots from different poses to one setpoint, under each set of gains."""
    goal = robot.start.copy()
    goal[: len(GOAL)] = GOAL
    spread = np.random.default_rng(0).uniform(-0.2, 0.2, (num_envs, robot.dof))
    starts = np.clip(robot.start + spread, robot.lower, robot.upper)
    found = {}
    for name, params in zip(COLOURS, (robot.designed(), robot.params(**BY_HAND)), strict=True):
        with Runner(robot, num_envs=num_envs, params=params, workers=0) as runner:
            runner.reset(starts)
            found[name] = runner.rollout(np.broadcast_to(goal, (round(seconds * 100), robot.dof)))
    return found


def draw_robots(axes: Any, robot: Robot, qpos: NDArray[np.float64]) -> None:
    """Draw robots at ``qpos`` (envs, dof) side by side, without perspective."""
    triangles, count = Triangles(robot), len(qpos)
    aside = SPACING * (np.arange(count) - (count - 1) / 2)[:, None] * RIGHT
    corners = triangles.corners(qpos, aside).reshape(-1, 3, 3)
    places = np.stack([corners @ RIGHT, corners @ np.cross(CAMERA, RIGHT)], axis=-1)
    paint(axes, corners, np.tile(triangles.colours, (count, 1)), places, -(corners @ CAMERA).mean(axis=1))


def draw_frame(robot: Robot, moves: dict[str, Rollout], at: int) -> Image.Image:
    """Return the picture of one tick: the robots under each set of gains, and the response until then."""
    figure = Figure(figsize=(8.4, 3.6), dpi=100)
    responses = figure.add_axes((0.70, 0.15, 0.28, 0.72))
    for row, (name, move) in enumerate(moves.items()):
        axes = figure.add_axes((0.0, 0.5 - 0.5 * row, 0.63, 0.5))
        draw_robots(axes, robot, move.qpos[at])
        axes.set(xlim=(-2.1, 2.0), ylim=(-0.3, 1.15), aspect="equal")
        axes.text(0.01, 0.9, name, color=COLOURS[name], weight="bold", transform=axes.transAxes, fontsize=10)
        axes.axis("off")
        responses.plot(move.time[: at + 1], move.qpos[: at + 1, :, JOINT], color=COLOURS[name], lw=1.0)
    move = next(iter(moves.values()))
    responses.axhline(GOAL[JOINT], color="black", lw=0.8, ls="--")
    responses.text(move.time[-1], GOAL[JOINT] + 0.02, "setpoint", fontsize=8, ha="right")
    low, high = (extreme([each.qpos[..., JOINT] for each in moves.values()]) for extreme in (np.min, np.max))
    responses.set(xlim=(0, move.time[-1]), ylim=(low - 0.05, high + 0.08))
    responses.set_title(f"{robot.joint_names[JOINT]} of each robot [rad]", fontsize=9, loc="left")
    responses.set_xlabel("time [s]", fontsize=8)
    responses.tick_params(labelsize=8)
    responses.spines[["top", "right"]].set_visible(False)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def main(options: Options) -> None:
    """Write the film; its last picture stays for a second."""
    robot = Robot.load("panda")
    moves = simulate(robot, options.seconds)
    every = round(options.interval * 100)
    ticks = [*range(0, round(options.seconds * 100), every)]
    frames = [draw_frame(robot, moves, at) for at in ticks]
    palette = frames[-1].quantize(48, dither=Image.Dither.NONE)
    few = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    shown = round(options.interval * 1000)
    times = [*[shown] * (len(few) - 1), 1000]
    few[0].save(options.out, save_all=True, append_images=few[1:], duration=times, loop=0, optimize=True)
    print(options.out)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
