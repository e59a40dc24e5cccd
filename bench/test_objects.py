"""A panda with a cube in an MJCF scene: closed loop over ``mujoco.batch`` without control, in the
same motion.

``mujoco.batch`` gets the efforts of our loop at every sim step. Both step the file's model, in turn
in one process. Processor time: another program disturbs it less.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

import mujoco.batch as mujoco_batch
import numpy as np
from lxml import etree
from numpy.typing import NDArray

from batchpid.sim import MujocoSolver, Robot, Runner
from batchpid.sim.engine.mujoco.mjcf_export import to_mjcf
from batchpid.sim.engine.mujoco.model_builder import robot_model
from batchpid.sim.engine.scene_spec import SceneSpec

TICKS, ROUNDS, SUBSTEPS, NUM_ENVS = 20, 5, 20, 64
CUBE = (
    '<body name="cube" pos=".5 0 .03"><freejoint/><geom type="box" size=".03 .03 .03"'
    ' density="400"/></body>'
)


def panda_with_a_cube(folder: Path) -> Robot:
    """Return a panda and a cube on a floor."""
    root = etree.fromstring(to_mjcf(Robot.load("panda"), None, 1 / 2000).text.encode())
    root.find("worldbody").append(etree.fromstring(CUBE))
    for keyframe in root.findall("keyframe"):
        root.remove(keyframe)
    path = folder / "panda_and_cube.xml"
    path.write_bytes(etree.tostring(root))
    return Robot.load(path)


def step_alone(robot: Robot, efforts: NDArray[Any]) -> tuple[float, NDArray[Any]]:
    """Return the processor time of an env step of ``mujoco.batch`` under efforts (steps, envs,
    dof), and the end.
    """
    options: dict[str, Any] = {"mjcf": robot.mjcf, "ground": robot.has_ground}
    options |= {"fixed_base": robot.fixed_base}
    built = robot_model(
        SceneSpec(
            robot.tables, robot.ignored_pairs, robot.joints, 1 / 2000, MujocoSolver(), **options
        )
    )
    steps, num_envs, _ = efforts.shape
    batch = mujoco_batch.Batch(built.model, num_envs, nthread=1, persistent=True)
    qpos, applied, seconds = batch.bind("qpos"), batch.bind("qfrc_applied"), 0.0
    qpos[:], qpos[:, built.qpos] = built.model.key_qpos[0], robot.start
    for rows in efforts:
        applied[:, built.qvel] = rows
        began = time.process_time()
        batch.step()
        seconds += time.process_time() - began
    return seconds / (steps * num_envs), qpos[:, built.qpos].copy()


def run_scene(
    robot: Robot, setpoints: NDArray[Any], substeps: int, **options: Any
) -> tuple[float, Any]:
    """Return the processor time of an env step of our loop under setpoints (ticks, envs, dof), and
    the rollout.
    """
    ticks, num_envs, _ = setpoints.shape
    with Runner(
        robot, num_envs, engine="mujoco", workers=0, substeps=substeps, **options
    ) as runner:
        runner.reset()
        began = time.process_time()
        rollout = runner.rollout(setpoints)
        return (time.process_time() - began) / (ticks * substeps * num_envs), rollout


def test_panda_with_a_cube(benchmark, report, compare, most, tmp_path):
    benchmark.group = "MuJoCo, in one process"
    robot, num_envs = panda_with_a_cube(tmp_path), min(NUM_ENVS, most.envs)
    ticks, rounds = min(TICKS, most.ticks), min(ROUNDS, most.rounds)
    target = Robot.load("panda").target
    setpoints = np.broadcast_to(target, (ticks, num_envs, robot.dof))
    _, known = run_scene(robot, setpoints.repeat(SUBSTEPS, axis=0), 1)

    def measure():
        rows = []
        for _ in range(rounds + 1):
            ours, rollout = run_scene(robot, setpoints, SUBSTEPS)
            alone, end = step_alone(robot, known.effort)
            np.testing.assert_allclose(end, rollout.qpos[-1], atol=1e-3)  # the same motion
            rows.append((ours, alone))
        assert np.abs(rollout.qpos[-1] - robot.start).max() > 0.02, "the robots did not move"
        return rows[1:]

    rows = benchmark.pedantic(measure, rounds=1)
    report([ours for ours, _ in rows])
    ratio = statistics.median(alone / ours for ours, alone in rows)
    benchmark.extra_info["over mujoco.batch without control"] = round(ratio, 3)
    compare(
        "panda and cube, designed gains",
        f"MuJoCo, {num_envs} envs",
        "mujoco.batch without control",
        ratio,
    )
