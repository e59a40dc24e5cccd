"""Robots that stand on the floor, or beside objects: the closed loop in MuJoCo over ``mujoco.batch`` without control,
in the same motion.

The peer steps the same compiled model with MuJoCo's default options from the same state, and gets
the efforts that the closed loop applied at each sim step. A user of ``mujoco.batch`` can set the
options of the closed loop, a sparse Jacobian and no islands: then the ratio is about 1.05. Robots
of the package example-robot-data are measured where it is installed, or where the variable
EXAMPLE_ROBOT_DATA names its folder ``robots``; a quadruped of boxes, and a panda with a cube beside
it, always are. Processor time, in one process, on one thread.
"""

from __future__ import annotations

import copy
import importlib.util
import os
import statistics
import time
from pathlib import Path

import mujoco
import mujoco.batch as mujoco_batch
import numpy as np
import pytest
from lxml import etree

from batchpid import PIDParams
from batchpid.sim import MujocoSolver, Robot, Runner
from batchpid.sim.engine.mujoco.model_builder import robot_model
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.mjcf_export import to_mjcf

NUM_ENVS, TICKS, ROUNDS, SUBSTEPS = 16, 20, 5, 20
SHAKE = 0.02
"""Size of the oscillation of the setpoints [rad]."""
FILES = {
    "Go2": "go2_description/urdf/go2.urdf",
    "G1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "Solo": "solo_description/robots/solo12.urdf",
}
FLOORS = {"Go2": 1.4, "G1": 1.4}
"""Least ratio over ``mujoco.batch`` without control."""
CUBE = """<body name="cube" pos=".5 0 .03"><freejoint/>
  <geom type="box" size=".03 .03 .03" density="400"/></body>"""
LINK = """<link name="{name}"><inertial><origin xyz="0 0 {down}"/><mass value="{mass}"/>
  <inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 0 {down}"/><geometry><box size="{size}"/></geometry></collision></link>"""
JOINT = """<joint name="{child}_joint" type="revolute"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{xyz}" rpy="0 {pitch} 0"/><axis xyz="0 1 0"/>
  <limit lower="-1.5" upper="1.5" effort="60" velocity="20"/></joint>"""


def quadruped() -> str:
    """Return the URDF of a trunk on four legs of two links, 20 kg, all boxes."""
    parts = [LINK.format(name="trunk", down=0, mass=14, inertia=0.3, size="0.5 0.3 0.1")]
    leg = {"down": -0.1, "inertia": 2e-3, "size": "0.03 0.03 0.22"}
    for number, (x, y) in enumerate(((0.2, 0.15), (0.2, -0.15), (-0.2, 0.15), (-0.2, -0.15))):
        thigh, calf = f"thigh{number}", f"calf{number}"
        parts += [LINK.format(name=thigh, mass=1.0, **leg), LINK.format(name=calf, mass=0.5, **leg)]
        parts.append(JOINT.format(parent="trunk", child=thigh, xyz=f"{x} {y} 0", pitch=0.6))
        parts.append(JOINT.format(parent=thigh, child=calf, xyz="0 0 -0.2", pitch=-1.2))
    return f'<robot name="quadruped">{"".join(parts)}</robot>'


def panda_with_a_cube() -> str:
    """Return the MJCF of a panda and a cube on a floor."""
    root = etree.fromstring(to_mjcf(Robot.load("panda"), None, 1 / 2000).text.encode())
    root.find("worldbody").append(etree.fromstring(CUBE))
    for keyframe in root.findall("keyframe"):
        root.remove(keyframe)
    return etree.tostring(root, encoding="unicode")


def load(name: str, folder: Path) -> Robot:
    """Return a robot on a floating base, or the panda; skip one whose file is not found."""
    if name == "panda and cube":
        path = folder / "panda_and_cube.xml"
        path.write_text(panda_with_a_cube())
        return Robot.load(path)
    if name == "boxes":
        path = folder / "quadruped.urdf"
        path.write_text(quadruped())
        return Robot.load(path, fixed_base=False)
    package = importlib.util.find_spec("example_robot_data")
    installed = (
        [Path(package.origin).parents[4] / "share/example-robot-data/robots"] if package else []
    )
    given = [Path(place) for place in (os.environ.get("EXAMPLE_ROBOT_DATA"),) if place]
    paths = [place / FILES[name] for place in (*given, *installed)]
    found = next((path for path in paths if path.is_file()), None)
    if found is None:
        pytest.skip(
            f"{FILES[name]} is not found: install example-robot-data, or set EXAMPLE_ROBOT_DATA"
        )
    return Robot.load(found, fixed_base=False)


def gains(robot: Robot) -> PIDParams:
    """Return the designed gains, with which joints follow moving setpoints."""
    return robot.designed().replace(setpoint_weight=1.0)


def setpoints(robot: Robot, steps: int) -> np.ndarray:
    """Return setpoints (steps / SUBSTEPS, dof) that oscillate about the start pose."""
    phase = np.arange(steps // SUBSTEPS)[:, None] * 0.3 + np.arange(robot.dof)
    return np.clip(robot.start + SHAKE * np.sin(phase), robot.lower, robot.upper)


def closed_loop(runner: Runner, table: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the processor time of an env step, and the last positions (envs, dof)."""
    runner.reset()
    began = time.process_time()
    qpos = runner.rollout(table).qpos[-1]
    return (time.process_time() - began) / (len(table) * SUBSTEPS * runner.num_envs), qpos


def efforts_of(robot: Robot, table: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the efforts (steps, dof) of the closed loop, and the poses (1, 7) of a floating base at
    the start.
    """
    with Runner(robot, 1, params=gains(robot), workers=0, engine="mujoco", substeps=1) as runner:
        base_pose = runner.reset().base_pose
        efforts = runner.rollout(np.repeat(table, SUBSTEPS, axis=0)).effort[:, 0]
        return efforts.astype(np.float64), base_pose


def bare_engine(
    robot: Robot, num_envs: int, efforts: np.ndarray, base_pose: np.ndarray | None
) -> tuple[float, np.ndarray]:
    """Return what :func:`closed_loop` returns, of ``mujoco.batch`` under ``efforts`` (steps,
    dof).
    """
    spec = SceneSpec(
        robot.tables,
        robot.self_contact.ignored,
        robot.joints,
        1 / 2000,
        MujocoSolver(),
        fixed_base=robot.fixed_base,
        mjcf=robot.mjcf,
    )
    built = robot_model(spec)
    model = copy.copy(built.model)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    batch = mujoco_batch.Batch(model, num_envs, nthread=1, persistent=True)
    qpos, applied = batch.bind("qpos"), batch.bind("qfrc_applied")
    if base_pose is None:
        qpos[:] = built.model.key_qpos[0]
    else:
        qpos[:, :7] = base_pose
    qpos[:, built.qpos] = robot.start
    began = time.process_time()
    for row in efforts:
        applied[:, built.qvel] = row
        batch.step()
    return (time.process_time() - began) / (len(efforts) * num_envs), qpos[:, built.qpos]


@pytest.mark.parametrize("name", [*FILES, "boxes", "panda and cube"])
def test_standing_robots(benchmark, report, compare, most, name, tmp_path):
    benchmark.group = "on the floor, in one process"
    robot, num_envs, rounds = (
        load(name, tmp_path),
        min(NUM_ENVS, most.envs),
        min(ROUNDS, most.rounds),
    )
    table = setpoints(robot, SUBSTEPS * min(TICKS, most.ticks))
    efforts, base_pose = efforts_of(robot, table)

    def measure():
        rows = []
        with Runner(
            robot, num_envs, params=gains(robot), workers=0, engine="mujoco", substeps=SUBSTEPS
        ) as runner:
            for _ in range(rounds + 1):
                (ours, moved), (bare, theirs) = (
                    closed_loop(runner, table),
                    bare_engine(robot, num_envs, efforts, base_pose),
                )
                np.testing.assert_allclose(moved, theirs, atol=2e-3)
                assert np.abs(moved - robot.start).max() > 0.1 * SHAKE, "the robots did not move"
                rows.append((ours, bare))
        return rows[1:]

    rows = benchmark.pedantic(measure, rounds=1)
    report([ours for ours, _ in rows])
    ratio = statistics.median(bare / ours for ours, bare in rows)
    benchmark.extra_info["over mujoco.batch without control"] = round(ratio, 3)
    case = f"closed loop, {num_envs} envs"
    compare(name, case, "mujoco.batch without control", ratio, FLOORS.get(name))
