"""One robot under many gains, in chunks: a recording for each, and after a kill the same command
goes on.

``python examples/many_gains.py --num-envs 256 --folder gains`` moves a panda under 256 proportional
gains. A recording is written as a whole or not at all, so one that exists is complete.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import tyro

from batchpid.sim import Robot, Rollout, Runner, read_recording, write_recording


def main(
    num_envs: int = 256, chunk: int = 64, seconds: float = 1.0, folder: Path = Path("out/gains")
) -> list[Rollout]:
    """Run the chunks that have no file yet, and return the rollouts of all."""
    robot = Robot.load("panda")
    kp = np.geomspace(20.0, 200.0, num_envs)
    setpoints = np.tile(robot.settings.target, (round(seconds / 0.01), 1))
    paths = []
    for first in range(0, num_envs, chunk):
        rows = kp[first : first + chunk]
        paths.append(folder / f"{first}.h5")
        if not paths[-1].exists():
            with Runner(robot, len(rows), params=robot.params(kp=rows[:, None])) as runner:
                write_recording(runner.rollout(setpoints), paths[-1])
    return [read_recording(path) for path in paths]


if __name__ == "__main__":
    for rollout in tyro.cli(main):
        print(rollout, np.abs(rollout.qpos[-1] - rollout.setpoint[-1]).max())
