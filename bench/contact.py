"""How many envs' bytes would depend on their neighbours in contact, how many do, and what that costs.

    python bench/contact.py

64 robots, four to a PhysX system, against the same robots with a system each; once with systems of their own for robots
that something touches (:mod:`sim.engine.contact_prediction`), and once without.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import tyro

from sim import Robot, Runner
from sim.engine.contact_prediction import Crowding

ENVS, SECONDS = 64, 2.0
JOBS = {
    # what they do: (scale of random efforts, the effort limit being 1, and options of the Runner)
    "random efforts up to the limits": (1.0, {}),
    "falling limply from random poses": (0.0, {"compensate": "none"}),
}


@contextmanager
def foresight(on: bool) -> Iterator[None]:
    """Robots keep to shared systems unless ``on``."""
    real = Crowding.foresees
    if not on:
        Crowding.foresees = lambda *_: False  # type: ignore[method-assign]
    try:
        yield
    finally:
        Crowding.foresees = real  # type: ignore[method-assign]


def run(robot: Robot, scale: float, physics: str, pack_size: int, **options: str) -> tuple[np.ndarray, float]:
    """The positions (ticks, envs, dof), and the seconds it took."""
    shape = (round(SECONDS * 100), ENVS, robot.dof)
    effort = scale * np.random.default_rng(0).normal(size=shape) * robot.effort_limit
    params = robot.params(kp=0.0, ki=0.0, kd=0.0)
    common = {"control": "effort", "params": params, "workers": 0, "pack_size": pack_size}
    with Runner(robot, ENVS, physics=physics, **common, **options) as runner:  # type: ignore[arg-type]
        runner.reset(robot.sample(ENVS, seed=0))
        began = time.perf_counter()
        qpos = runner.rollout(effort).qpos
        took = time.perf_counter() - began
    assert np.abs(qpos[-1] - qpos[0]).max() > 0.1, "the robots did not move"
    return qpos, took


def main(robots: tuple[str, ...] = ("jaco2", "panda")) -> None:
    """Print the table of docs/reliability.md."""
    print("| 64 robots, 2 s | solver | without | with | time |\n| --- | --- | --- | --- | --- |")
    for name in robots:
        for job, (scale, options) in JOBS.items():
            for physics in ("accurate", "fast"):
                left, took = {}, {}
                for on in (False, True):
                    with foresight(on):
                        alone, _ = run(Robot.load(name), scale, physics, 1, **options)
                        packed, took[on] = run(Robot.load(name), scale, physics, 4, **options)
                    left[on] = int((alone != packed).any((0, 2)).sum())
                ratio = f"{took[True] / took[False]:.2f}"
                print(f"| {name}, {job} | {physics} | {left[False]} | {left[True]} | {ratio} |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
