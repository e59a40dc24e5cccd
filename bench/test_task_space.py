"""Cost of operational-space control and of inverse kinematics of a panda: native rows against
NumPy.

"regular" rows are at a pose where the inverse of the mobility is Cholesky's, "bounded" rows near a
straight arm, where each needs its eigenvalues. ``step`` is the law with the dynamics of a tree, in
one call; its parts are timed as separate calls. Searches start 0.3 rad away from a solution.

The closed loop under control "osc" is compared with that under joint PID in one process in turn, by
processor time.
"""

from __future__ import annotations

import os
import statistics
import time
from unittest import mock

import numpy as np
import pytest
from workload import Workload

import batchpid.task_space as ts
from batchpid.native.array_program import SWITCH
from batchpid.sim import OperationalSpace, Robot, Runner
from batchpid.task_space import native_rows

LINK = "panda_hand"
POSES = {
    "regular": [0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8, 0.02, 0.02],
    "bounded": [0.0, 0.0, 0.0, -0.07, 0.0, 0.01, 0.0, 0.02, 0.02],
}
SMALLEST_EIGENVALUE = {"regular": 0.02, "bounded": 0.2}


def best(call, seconds):
    """Return the least time of a call [s]."""
    call()
    times, until = [], time.perf_counter() + seconds
    while not times or time.perf_counter() < until:
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times)


@pytest.mark.benchmark(group="task space")
@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("num_envs", [1, 16, 64, 1024])
def test_osc_step(benchmark, compare, most, num_envs, pose):
    if native_rows.in_use() is None:
        pytest.skip("there is no extension")
    robot = Robot.load("panda")
    tree, rows, rng = (
        robot.kinematic_tree(),
        int(min(num_envs, most.rows)),
        np.random.default_rng(0),
    )
    qpos = POSES[pose] + 0.01 * rng.normal(size=(rows, tree.dof))
    qvel = 0.1 * rng.normal(size=qpos.shape)
    options = {"effort_limit": robot.effort_limit, "smallest_eigenvalue": SMALLEST_EIGENVALUE[pose]}
    params = ts.make_osc_params(tree, 1 / 2000, **options)
    state, goal = (
        ts.init(params, qpos),
        ts.link_poses(tree, qpos, [LINK])[:, 0] + [0.05, 0, 0, 0, 0, 0, 0],
    )
    d, tool, inputs = (
        ts.task_dynamics(tree, qpos, qvel, LINK),
        ts.Tool(tree, LINK),
        ts.OSCInputs(goal, qpos, qvel),
    )

    def step():
        return ts.osc(params, state, tool, inputs)

    near = step()[1].near_singular
    assert near.all() if pose == "bounded" else not near.any()
    seconds = min(0.3, most.seconds)
    with mock.patch.dict(os.environ, {SWITCH: "0"}):
        in_numpy = best(step, seconds)
    benchmark.pedantic(step, rounds=int(min(2000, most.rounds)), warmup_rounds=2)
    least = benchmark.stats.stats.min
    parts = {
        "dynamics": best(lambda: ts.task_dynamics(tree, qpos, qvel, LINK), seconds),
        "law": best(lambda: ts.osc(params, state, d, inputs), seconds),
    }
    for name, time_of_part in {"step": least, **parts, "step in NumPy": in_numpy}.items():
        benchmark.extra_info[f"{name} [us]"] = 1e6 * time_of_part / rows
    print("", *(f"{name} {us:.2f}" for name, us in benchmark.extra_info.items()), sep="\n")
    compare(f"{num_envs} envs, {pose}", "native", "numpy", in_numpy / least, least=4)


@pytest.mark.benchmark(group="inverse kinematics")
@pytest.mark.parametrize("num_envs", [1, 64, 500])
def test_search(benchmark, compare, most, num_envs):
    if native_rows.in_use() is None:
        pytest.skip("there is no extension")
    tree, rows, rng = (
        Robot.load("panda").kinematic_tree(),
        int(min(num_envs, most.rows)),
        np.random.default_rng(0),
    )
    qpos = rng.uniform(tree.lower, tree.upper, (rows, tree.dof))
    goal, way = (
        ts.link_poses(tree, qpos, [LINK])[:, 0],
        tree.chain(LINK) * rng.normal(size=qpos.shape),
    )
    start = qpos + 0.3 * way / np.linalg.norm(way, axis=1, keepdims=True)

    def search():
        return ts.inverse_kinematics(tree, LINK, goal, start, starts=1, on_failure="return")

    found = search()
    assert found.success.mean() >= 0.99
    with mock.patch.dict(os.environ, {SWITCH: "0"}):
        in_numpy = best(search, min(0.3, most.seconds))
    benchmark.pedantic(search, rounds=int(min(2000, most.rounds)), warmup_rounds=2)
    least, steps = benchmark.stats.stats.min, found.iterations.sum()
    for name, time_of_part in {"per step": least, "per step in NumPy": in_numpy}.items():
        benchmark.extra_info[f"{name} [us]"] = 1e6 * time_of_part / steps
    print("", *(f"{name} {us:.2f}" for name, us in benchmark.extra_info.items()), sep="\n")
    compare(f"{num_envs} targets", "native", "numpy", in_numpy / least, least=4)


@pytest.mark.benchmark(group="closed loop under osc")
@pytest.mark.parametrize("num_envs", [1, 16, 64])
@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_closed_loop(benchmark, report, compare, most, engine, num_envs):
    """One env alone has no floor: the law computes four at once."""
    robot, num_envs = Robot.load("panda"), int(min(num_envs, most.envs))
    ticks, rounds = int(min(40 if num_envs == 1 else 20, most.ticks)), int(min(7, most.rounds))
    work = Workload(robot, num_envs, workers=0, ticks=ticks)
    goal = ts.link_poses(robot.kinematic_tree(), work.target[None], [LINK])[0, 0]
    osc, options = (
        OperationalSpace(robot, LINK, posture=work.target),
        {"engine": engine, "workers": 0},
    )

    def seconds_per_env_step(runner, setpoint):
        runner.reset(work.start)
        setpoints = np.broadcast_to(setpoint, (ticks, num_envs, len(setpoint)))
        began = time.process_time()
        qpos = runner.rollout(setpoints).qpos[-1]
        seconds = time.process_time() - began
        assert (np.abs(qpos - work.start)[:, work.moving].max(1) > 0.05).all(), (
            "the robots did not move"
        )
        return seconds / (work.steps * num_envs)

    def measure():
        with (
            Runner(robot, num_envs, control=osc, **options) as tool,
            Runner(robot, num_envs, **options) as tuned,
            Runner(robot, num_envs, params=robot.params(), **options) as tutorial,
        ):
            cases = (tool, goal), (tuned, work.target), (tutorial, work.target)
            return [[seconds_per_env_step(*case) for case in cases] for _ in range(rounds + 1)][
                -rounds:
            ]

    rows = benchmark.pedantic(measure, rounds=1)
    report([row[0] for row in rows])
    # 0.9 of the measured median; joint PID of arms in free motion is a compiled pass in MuJoCo
    least = None if num_envs == 1 else {"sapien": 0.86, "mujoco": 0.42}[engine]
    for column, gains in ((1, "tuned"), (2, "tutorial")):
        ratio = statistics.median(row[column] / row[0] for row in rows)
        compare(
            f"{engine}, {num_envs} envs", "osc", f"joint PID, {gains} gains", ratio, least=least
        )
