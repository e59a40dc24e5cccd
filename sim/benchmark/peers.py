"""Third-party baselines of the benchmark: MuJoCo, Gymnasium.

Their packages are in the extra ``peers``.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Float64
from batchpid.errors import MissingDependencyError
from batchpid.sim.benchmark.baselines import single_threaded
from batchpid.sim.benchmark.tutorial import TutorialLoop, tutorial_settings
from batchpid.sim.benchmark.workload import TIMESTEP, Case, Workload


class Peer(NamedTuple):
    """Third-party baseline: a description, the package that it needs, and its constructor."""

    description: str
    package: str
    make: Callable[[Workload], Case]


def _async_vector(workload: Workload, count: int) -> Case:
    """Return Gymnasium's AsyncVectorEnv around the tutorial's loop, with one process for each of ``count`` envs."""
    import gymnasium

    # Fork the processes from one that has loaded all packages; otherwise many of them would take a minute to start.
    multiprocessing.set_forkserver_preload([__name__, "gymnasium", "sapien.wrapper.urdf_loader"])
    make_envs = [lambda: _tutorial_env(workload)] * count
    with single_threaded():
        envs = gymnasium.vector.AsyncVectorEnv(make_envs, context="forkserver")
    actions = np.tile(workload.target, (count, 1))

    def run() -> NDArray[np.float32]:
        for _ in range(workload.ticks):
            qpos = envs.step(actions)[0]
        return qpos[0]

    return Case(workload.steps * count, envs.reset, run, envs.close, min(count, workload.processes))


def _tutorial_env(workload: Workload) -> Any:
    """Return the tutorial's loop as an env. The action is the target; a step is ``workload.substeps`` sim steps."""
    import gymnasium

    class TutorialEnv(gymnasium.Env):
        def __init__(self) -> None:
            self._loop = TutorialLoop(workload.robot, workload.target, start=workload.start)
            shape = workload.target.shape
            self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)
            self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float64)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
            super().reset(seed=seed)
            self._loop.reset()
            return self._loop.robot.get_qpos(), {}

        def step(self, action: Float64) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            self._loop.target = action
            return self._loop.run(workload.substeps), 0.0, False, False, {}

    return TutorialEnv()


def _mujoco_batch(workload: Workload) -> Case:
    """Return ``mujoco.batch`` on the same URDF, with one thread for each worker.

    MuJoCo's actuator ``pid`` drives the joints with the same kp, ki and kd. Gravity is compensated body by body. The
    sum of both stays within the URDF's effort limits. The scene has a ground. The solver is Newton, and the integrator
    "implicitfast", which MuJoCo's documentation recommends.
    """
    import mujoco
    import mujoco.batch

    robot, settings = workload.robot, tutorial_settings(workload.robot)
    spec = mujoco.MjSpec.from_string(robot.urdf)
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    for body in spec.bodies:
        body.gravcomp = 1
    for joint in spec.joints:
        joint.actgravcomp = True  # the effort limits, which MuJoCo reads from the URDF, include it
    for name, kp, ki, kd in zip(robot.joint_names, settings.kp, settings.ki, settings.kd, strict=True):
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_pid(kp=kp, ki=ki, kv=kd, ctrlspec=mujoco.mjtCtrlInput.mjINPUT_POS)
    model, kind = spec.compile(), mujoco.mjtState.mjSTATE_INTEGRATION
    columns = [model.joint(name).qposadr[0] for name in robot.joint_names]
    data, start = mujoco.MjData(model), np.empty(mujoco.mj_stateSize(model, kind))
    data.qpos[columns], data.ctrl[:] = workload.start, workload.target
    mujoco.mj_getState(model, data, start, kind)
    batch = mujoco.batch.Batch(model, workload.num_envs, nthread=workload.processes, persistent=True)

    def reset() -> None:
        batch.state[:] = start

    def run() -> Float64:
        for _ in range(workload.ticks):
            batch.step(nstep=workload.substeps)
        return np.array(batch.qpos[0, columns])

    return Case(workload.num_envs * workload.steps, reset, run, lambda: None, workload.processes)


PEERS = {
    "gymnasium, an env a core": Peer(
        "AsyncVectorEnv around the tutorial's loop, one env per core",
        "gymnasium",
        lambda workload: _async_vector(workload, workload.processes),
    ),
    "gymnasium, all envs": Peer(
        "the same with all envs, one process per env",
        "gymnasium",
        lambda workload: _async_vector(workload, workload.num_envs),
    ),
    "mujoco": Peer(
        "mujoco.batch on the same URDF, one thread per core: its PID actuators, gravity compensation and solver",
        "mujoco",
        _mujoco_batch,
    ),
}


def installed_peers() -> tuple[str, ...]:
    """Return the names of the peers whose package is installed."""
    return tuple(name for name, peer in PEERS.items() if importlib.util.find_spec(peer.package) is not None)


def make_peers(workload: Workload, names: Collection[str]) -> dict[str, Case]:
    """Return the peers of these names, ready to run; raise MissingDependencyError where a package is missing."""
    for name in names:
        if importlib.util.find_spec(PEERS[name].package) is None:
            raise MissingDependencyError(PEERS[name].package, f"peer {name!r}", "peers")
    return {name: PEERS[name].make(workload) for name in names}
