"""Third-party baselines of the benchmark: Gymnasium's AsyncVectorEnv, and MuJoCo."""

from __future__ import annotations

import importlib.util
import multiprocessing
from collections.abc import Sequence
from typing import Any

import numpy as np
from baselines import single_threaded
from tutorial import TutorialLoop
from workload import TIMESTEP, Case, Workload

from batchpid.sim import Robot


def _async_vector(workload: Workload, count: int) -> Case:
    """Return Gymnasium's AsyncVectorEnv around the tutorial's loop, with one process for each of
    ``count`` envs.
    """
    import gymnasium

    # Fork the processes from one that has loaded the packages; otherwise many of them would take a
    # minute to start.
    packages = [
        "gymnasium",
        "batchpid.sim.engine.sapien.user_content",
        "sapien.wrapper.urdf_loader",
    ]
    multiprocessing.set_forkserver_preload(packages)
    make_envs = [lambda: _tutorial_env(workload)] * count
    with single_threaded():
        envs = gymnasium.vector.AsyncVectorEnv(make_envs, context="forkserver")
    actions = np.tile(workload.target, (count, 1))

    def run() -> np.ndarray:
        for _ in range(workload.ticks):
            qpos = envs.step(actions)[0]
        return qpos[0]

    return Case(workload.steps * count, envs.reset, run, envs.close, min(count, workload.processes))


def _tutorial_env(workload: Workload) -> Any:
    """Return the tutorial's loop as an env. The action is the target; a step is
    ``workload.substeps`` sim steps.
    """
    import gymnasium

    class TutorialEnv(gymnasium.Env):
        def __init__(self) -> None:
            self._loop = TutorialLoop(workload.robot, workload.target, start=workload.start)
            shape = workload.target.shape
            self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)
            self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float64)

        def reset(
            self, *, seed: int | None = None, options: Any = None
        ) -> tuple[Any, dict[str, Any]]:
            super().reset(seed=seed)
            self._loop.reset()
            return self._loop.robot.get_qpos(), {}

        def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            self._loop.target = action
            return self._loop.run(workload.substeps), 0.0, False, False, {}

    return TutorialEnv()


def batch_with_pid(
    robot: Robot,
    gains: Sequence[np.ndarray],
    num_envs: int,
    threads: int,
    start: np.ndarray,
    target: np.ndarray,
) -> tuple[Any, np.ndarray, list[int]]:
    """Return ``mujoco.batch`` on the URDF of a robot, the state of each env at ``start`` (dof,) with
    the setpoint ``target`` (dof,), and the columns of the joints in its positions.

    MuJoCo's actuator ``pid`` drives the joints with the gains kp, ki and kd (dof,). Gravity is
    compensated body by body. The sum of both stays within the URDF's effort limits. The scene has a
    ground, if the robot has one. The solver is Newton, and the integrator "implicitfast", which
    MuJoCo's documentation recommends.
    """
    import mujoco
    import mujoco.batch

    from batchpid.sim import to_urdf

    spec = mujoco.MjSpec.from_string(to_urdf(robot).text)
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    if robot.has_ground:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    for body in spec.bodies:
        body.gravcomp = 1
    for joint in spec.joints:
        joint.actgravcomp = True  # the effort limits, which MuJoCo reads from the URDF, include it
    for name, kp, ki, kd in zip(robot.joint_names, *gains, strict=True):
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_pid(kp=kp, ki=ki, kv=kd, ctrlspec=mujoco.mjtCtrlInput.mjINPUT_POS)
    model, kind = spec.compile(), mujoco.mjtState.mjSTATE_INTEGRATION
    columns = [model.joint(name).qposadr[0] for name in robot.joint_names]
    data, state = mujoco.MjData(model), np.empty(mujoco.mj_stateSize(model, kind))
    data.qpos[columns], data.ctrl[:] = start, target
    mujoco.mj_getState(model, data, state, kind)
    batch = mujoco.batch.Batch(model, num_envs, nthread=threads, persistent=True)
    return batch, state, columns


def _mujoco_batch(workload: Workload) -> Case:
    """Return :func:`batch_with_pid` on the same URDF, with one thread for each worker."""
    settings = workload.robot.settings
    batch, start, columns = batch_with_pid(
        workload.robot,
        (settings.kp, settings.ki, settings.kd),
        workload.num_envs,
        workload.processes,
        workload.start,
        workload.target,
    )

    def reset() -> None:
        batch.state[:] = start

    def run() -> np.ndarray:
        for _ in range(workload.ticks):
            batch.step(nstep=workload.substeps)
        return np.array(batch.qpos[0, columns])

    return Case(workload.num_envs * workload.steps, reset, run, lambda: None, workload.processes)


PEERS = {
    # name: (package, constructor of the case)
    "gymnasium, an env a core": (
        "gymnasium",
        lambda workload: _async_vector(workload, workload.processes),
    ),
    "gymnasium, all envs": (
        "gymnasium",
        lambda workload: _async_vector(workload, workload.num_envs),
    ),
    "mujoco": ("mujoco", _mujoco_batch),
}


def installed_peers() -> list[str]:
    """Return the names of the peers whose package is installed."""
    return [
        name
        for name, (package, _) in PEERS.items()
        if importlib.util.find_spec(package) is not None
    ]
