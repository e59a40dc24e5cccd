"""Film of four robots under two sets of gains, with the response of one joint: ``python bench/film.py``.

It draws docs/images/two-gains.gif, the picture of the README, without a render device. The gains are from
docs/tutorial.md: designed, and chosen by hand. With ``--recording walk.h5 --seconds 4 --interval 0.08 --out
docs/images/walk.gif`` it draws four robots that walk, from a recording of ``examples/train_walk.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from batchpid.sim import Robot, Rollout, Runner, read_recording
from batchpid.sim.view.film import Triangles, paint
from batchpid.task_space.rotations import about, placed, rotate

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
AHEAD = np.r_[0.0, 0.0, 0.0, about(np.array([0.0, 0.0, 1.0]), 1.8)]
"""Pose of the world for robots that walk: its x axis points to the right of the picture, and a little to the back."""


@dataclass(frozen=True)
class Options:
    """Draw the film of the README."""

    out: Path = PICTURE
    """File of the film, a GIF."""
    seconds: float = 2.0
    """Length [s]."""
    interval: float = 0.05
    """Time between two pictures [s]."""
    recording: Path | None = None
    """Recording of robots with a floating base, such as of ``examples/train_walk.py --record``, to film instead."""


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


def draw_robots(axes: Any, robot: Robot, qpos: NDArray[Any], base_pose: NDArray[Any] | None = None) -> None:
    """Draw robots at ``qpos`` (envs, dof) side by side, without perspective, with poses (envs, 7) of floating bases."""
    triangles, count = Triangles(robot), len(qpos)
    aside = SPACING * (np.arange(count) - (count - 1) / 2)[:, None] * RIGHT
    corners = triangles.corners(qpos, aside, base_pose).reshape(-1, 3, 3)
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
    return image_of(figure)


def draw_walk(robot: Robot, walk: Rollout, at: int) -> Image.Image:
    """Return the picture of one tick of the first robots with a floating base; the camera moves with them."""
    figure = Figure(figsize=(8.4, 3.0), dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    assert walk.base_pose is not None
    base = placed(AHEAD, walk.base_pose[at, :4].astype(float))
    lines = [[(x, -9.0, 0.0), (x, 9.0, 0.0)] for x in np.arange(-5.0, 10.0, 0.5)]  # on the floor, across the way
    for ends in rotate(AHEAD[3:], np.array(lines)) @ np.stack([RIGHT, np.cross(CAMERA, RIGHT)], axis=-1):
        axes.plot(*ends.T, color="#c9ced6", lw=1.0, zorder=0)
    draw_robots(axes, robot, walk.qpos[at, :4], base)
    middle = base[:, :3].mean(0) @ RIGHT
    axes.set(xlim=(middle - 2.1, middle + 2.1), ylim=(-0.6, 0.9), aspect="equal")
    axes.text(0.02, 0.9, f"{walk.time[at]:.1f} s", transform=axes.transAxes, fontsize=10)
    axes.axis("off")
    return image_of(figure)


def image_of(figure: Figure) -> Image.Image:
    """Return the picture of a figure."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


def main(options: Options) -> None:
    """Write the film; its last picture stays for a second."""
    if options.recording is None:
        robot, rate = Robot.load("panda"), 100
        draw = partial(draw_frame, robot, simulate(robot, options.seconds))
    else:
        walk = read_recording(options.recording)
        rate = round(1 / (walk.time[1] - walk.time[0]))
        draw = partial(draw_walk, Robot.load(walk.info.robot, fixed_base=False), walk)
    every = max(1, round(options.interval * rate))
    frames = [draw(at) for at in range(0, round(options.seconds * rate), every)]
    palette = frames[-1].quantize(48, dither=Image.Dither.NONE)
    few = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    shown = round(every / rate * 1000)
    times = [*[shown] * (len(few) - 1), 1000]
    few[0].save(options.out, save_all=True, append_images=few[1:], duration=times, loop=0, optimize=True)
    print(options.out)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
