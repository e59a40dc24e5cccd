"""Arms in free motion: the closed loop in MuJoCo over ``mujoco.batch`` with a PID of its own, in the
same motion.

The peer has MuJoCo's actuators ``pid`` and its own compensation of gravity. Processor time, in one
process, on one thread, in turn.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from peers import batch_with_pid

from batchpid.sim import Robot, Runner
from batchpid.sim.engine import native

NUM_ENVS, TICKS, SUBSTEPS, ROUNDS = 64, 40, 20, 5
SHORT_TICKS = 10
"""Ticks of an episode whose reset is counted."""
LINK = """<link name="{name}"><inertial><origin xyz="0 0 {half}"/><mass value="{mass}"/>
  <inertia ixx="{across}" iyy="{across}" izz="{along}" ixy="0" ixz="0" iyz="0"/></inertial>{shape}</link>"""
SHAPE = """<collision><origin xyz="0 0 {half}"/><geometry><cylinder radius="0.04" length="{size}"/>
  </geometry></collision>"""
JOINT = """<joint name="{child}_joint" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{xyz}"/><axis xyz="{axis}"/>
  <limit lower="{low}" upper="{high}" effort="{effort}" velocity="3"/>
  <dynamics damping="0.5" friction="{friction}"/>{mimic}</joint>"""
MASSES = 6.0, 5.0, 4.0, 2.0, 1.0, 0.5
"""Of the links of the foreign arm [kg]."""


class Floors(NamedTuple):
    """Least ratios over ``mujoco.batch`` with its own PID."""

    rollout: float
    step: float
    episode: float


FLOORS = {
    "panda": Floors(11.0, 10.0, 7.2),
    "six joints": Floors(12.5, 11.0, 8.6),
    "six joints with shapes": Floors(13.5, 12.2, 9.8),
    "coupled gripper": Floors(9.5, 8.4, 7.6),
    "jaco2": Floors(10.0, 9.2, 9.0),
}


def foreign_arm(shapes: bool, gripper: bool) -> str:
    """Return the URDF of an arm of six joints, with cylinders or without, and a gripper of two
    coupled fingers or none.
    """
    parts = ['<link name="link0"/>']

    def add(
        child: str,
        parent: str,
        mass: float,
        size: float,
        mimic: str = "",
        **joint: Any,
    ) -> None:
        shape = SHAPE.format(half=size / 2, size=0.6 * size) if shapes else ""
        numbers = {"across": mass * size**2 / 12 + 1e-4, "along": 8e-4 * mass + 1e-5}
        parts.append(LINK.format(name=child, half=size / 2, mass=mass, shape=shape, **numbers))
        given = {"kind": "revolute", "low": -2.9, "high": 2.9, "effort": 150, "friction": 0.3}
        parts.append(JOINT.format(child=child, parent=parent, mimic=mimic, **given | joint))

    for number, mass in enumerate(MASSES, start=1):
        axis = "0 0 1" if number in (1, 4, 6) else "0 1 0"
        size = 0.3 if number < 4 else 0.12
        below = 0.0 if number == 1 else 0.3 if number < 5 else 0.12
        add(f"link{number}", f"link{number - 1}", mass, size, axis=axis, xyz=f"0 0 {below}")
    for side in (1, -1) if gripper else ():
        finger = {"kind": "prismatic", "low": 0.0, "high": 0.04, "effort": 20, "friction": 0}
        mimic = '<mimic joint="finger1_joint"/>' if side < 0 else ""
        place = {"axis": f"0 {side} 0", "xyz": f"0 {0.06 * side} 0.12", "mimic": mimic}
        add(f"finger{1 if side > 0 else 2}", "link6", 0.1, 0.06, **finger | place)
    return f'<robot name="arm">{"".join(parts)}</robot>'


def load(name: str, folder: Path) -> Robot:
    """Return a bundled robot, or a foreign one."""
    if name in Robot.bundled():
        return Robot.load(name)
    path = folder / "arm.urdf"
    path.write_text(foreign_arm(name != "six joints", name == "coupled gripper"))
    return Robot.load(path)


def poses(robot: Robot, num_envs: int) -> tuple[np.ndarray, np.ndarray]:
    """Return start poses (num_envs, dof), and the target (dof,)."""
    middle = 0.5 * (np.maximum(robot.lower, -1.0) + np.minimum(robot.upper, 1.0))
    start = robot.start if robot.settings is not None else 0.2 * np.ones(robot.dof) + middle
    target = robot.target if robot.settings is not None else start + 0.3 * (robot.upper > 1.0)
    noise = np.random.default_rng(0).uniform(-0.05, 0.05, (num_envs, robot.dof))
    starts = np.clip(start + noise, robot.lower, robot.upper)
    return robot.coupling.positions(starts), robot.coupling.positions(
        np.clip(target, robot.lower, robot.upper)
    )


def peer(robot: Robot, num_envs: int) -> Callable[[int], float]:
    """Return a function of the ticks that runs ``mujoco.batch`` with its own PID from a reset, and
    returns the processor time of an env step.
    """
    gains = robot.designed("effort")
    each = gains.kp[0], gains.ki[0], gains.kd[0]
    starts, target = poses(robot, num_envs)
    batch, state, columns = batch_with_pid(robot, each, num_envs, 1, starts[0], target)

    def run(ticks: int) -> float:
        began = time.process_time()
        batch.state[:] = state
        batch.qpos[:, columns] = starts
        for _ in range(ticks):
            batch.step(nstep=SUBSTEPS)
        seconds = time.process_time() - began
        assert np.abs(batch.qpos[:, columns] - starts).max() > 0.01, "the robots did not move"
        return seconds / (ticks * SUBSTEPS * num_envs)

    return run


@contextmanager
def closed_loop(robot: Robot, num_envs: int) -> Iterator[dict[str, Callable[[int], float]]]:
    """Yield functions of the ticks that return the processor time of an env step: by rollout and
    by step after a reset, and by rollout with it.
    """
    starts, target = poses(robot, num_envs)
    with Runner(robot, num_envs, engine="mujoco", workers=0, substeps=SUBSTEPS) as runner:
        assert native.obstacle() or "native calls into MuJoCo" in runner.backend, runner.backend

        def rollout(ticks: int) -> None:
            qpos = runner.rollout(np.tile(target, (ticks, num_envs, 1))).qpos
            assert np.abs(qpos[-1] - starts).max() > 0.01, "the robots did not move"

        def step(ticks: int) -> None:
            for _ in range(ticks):
                runner.step(target)

        def timed(run: Callable[[int], None], counts_reset: bool) -> Callable[[int], float]:
            def seconds(ticks: int) -> float:
                began = time.process_time()
                runner.reset(qpos=starts)
                if not counts_reset:
                    began = time.process_time()
                run(ticks)
                return (time.process_time() - began) / (ticks * SUBSTEPS * num_envs)

            return seconds

        yield {
            "rollout": timed(rollout, False),
            "step": timed(step, False),
            "episode": timed(rollout, True),
        }


@pytest.mark.parametrize("name", FLOORS)
def test_arms_in_free_motion(benchmark, report, compare, most, name, tmp_path):
    benchmark.group = "arms in free motion, in one process"
    robot, num_envs = load(name, tmp_path), min(NUM_ENVS, most.envs)
    ticks, rounds = min(TICKS, most.ticks), min(ROUNDS, most.rounds)
    lengths = {"rollout": ticks, "step": ticks, "episode": min(SHORT_TICKS, ticks)}
    theirs = peer(robot, num_envs)

    def measure() -> dict[str, list[tuple[float, float]]]:
        rows: dict[str, list[tuple[float, float]]] = {kind: [] for kind in lengths}
        with closed_loop(robot, num_envs) as ours:
            # For a run of another length new programs are made: runs of one length come together.
            for kind, length in lengths.items():
                for _ in range(rounds + 1):
                    rows[kind].append((ours[kind](length), theirs(length)))
        return {kind: both[1:] for kind, both in rows.items()}

    rows = benchmark.pedantic(measure, rounds=1)
    report([ours for ours, _ in rows["rollout"]])
    for kind, both in rows.items():
        ratio = statistics.median(other / ours for ours, other in both)
        benchmark.extra_info[f"{kind} over mujoco.batch with PID"] = round(ratio, 2)
        case = f"{kind} of {lengths[kind] * SUBSTEPS} sim steps, {num_envs} envs"
        compare(name, case, "mujoco.batch with PID", ratio, getattr(FLOORS[name], kind))
