"""Count the envs whose results depend on their neighbours in contact, and time the prevention of it.

    python bench/contact.py

64 robots, four in each PhysX system, are compared with the same robots in separate systems: once with the prediction of
contacts (:mod:`batchpid.sim.engine.sapien.contact_prediction`), which moves a robot to a separate system before
anything touches it, and once without. Prints the table of docs/reliability.md.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import tyro

from batchpid.sim import Robot, Runner
from batchpid.sim.engine.sapien.contact_prediction import ContactPredictor

MOTIONS: dict[str, tuple[float, dict[str, Any]]] = {
    # name: (standard deviation of random efforts, in effort limits; options of the Runner)
    "random efforts up to the limits": (1.0, {}),
    "falling limply from random poses": (0.0, {"compensate": "none"}),
}


@contextmanager
def prediction(enabled: bool) -> Iterator[None]:
    """Predict no contacts unless ``enabled``."""
    predicts_contact = ContactPredictor.predicts_contact
    if not enabled:
        ContactPredictor.predicts_contact = lambda *_: False  # type: ignore[method-assign]
    try:
        yield
    finally:
        ContactPredictor.predicts_contact = predicts_contact  # type: ignore[method-assign]


def run(
    robot: Robot, shape: tuple[int, int], scale: float, physics: str, pack_size: int, **options: Any
) -> tuple[np.ndarray, float]:
    """Return the positions (ticks, envs, dof), with ``shape`` (ticks, envs), and the seconds it took."""
    effort = scale * np.random.default_rng(0).normal(size=(*shape, robot.dof)) * robot.effort_limit
    params = robot.params(kp=0.0, ki=0.0, kd=0.0)
    common: dict[str, Any] = {"control": "effort", "params": params, "workers": 0, "pack_size": pack_size}
    with Runner(robot, shape[1], physics=physics, **common, **options) as runner:
        runner.reset(robot.sample(shape[1], seed=0))
        began = time.perf_counter()
        qpos = runner.rollout(effort).qpos
        seconds = time.perf_counter() - began
    assert np.abs(qpos[-1] - qpos[0]).max() > 0.1, "the robots did not move"
    return qpos, seconds


def main(robots: tuple[str, ...] = ("jaco2", "panda"), num_envs: int = 64, seconds: float = 2.0) -> None:
    """Print the envs that differ without and with the prediction, and the time with it over that without."""
    shape = round(seconds * 100), num_envs
    print(f"| {num_envs} robots, {seconds:g} s | solver | without | with | time |\n| --- | --- | --- | --- | --- |")
    for name in robots:
        robot = Robot.load(name)
        for motion, (scale, options) in MOTIONS.items():
            for physics in ("accurate", "fast"):
                different, took = {}, {}
                for enabled in (False, True):
                    with prediction(enabled):
                        alone, _ = run(robot, shape, scale, physics, 1, **options)
                        packed, took[enabled] = run(robot, shape, scale, physics, 4, **options)
                    different[enabled] = int((alone != packed).any((0, 2)).sum())
                ratio = f"{took[True] / took[False]:.2f}"
                row = (f"{name}, {motion}", physics, different[False], different[True], ratio)
                print(f"| {' | '.join(map(str, row))} |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
