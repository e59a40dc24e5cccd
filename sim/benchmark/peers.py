"""What else steps many robots on a CPU, beside the Runner in one run of the benchmark (:mod:`sim.benchmark.benchmark`).

Each peer comes with a package that nothing else here needs: the extra ``peers``.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import MissingDependencyError
from sim.benchmark.baselines import single_threaded
from sim.benchmark.setup import Setup
from sim.benchmark.tutorial import TutorialLoop

Float64 = NDArray[np.float64]


class Stepper(Protocol):
    """What a peer is to the benchmark."""

    def reset(self) -> None:
        """Put the robots at the start."""

    def run(self, ticks: int) -> tuple[int, Float64]:
        """Step; the env-steps made, and where the first env ended (dof,)."""

    def close(self) -> None:
        """Free what it holds."""


class Peer(NamedTuple):
    """A peer: what it is, the package it takes, and how to make it."""

    description: str
    package: str
    make: Callable[[Setup], Stepper]


class AsyncVector:
    """Gymnasium's AsyncVectorEnv around the tutorial's loop: a process for each of ``count`` envs."""

    def __init__(self, setup: Setup, count: int) -> None:
        import gymnasium

        self._setup, self._count = setup, count
        # The processes are forks of one that has loaded all packages: else many would take a minute to start.
        multiprocessing.set_forkserver_preload([__name__, "gymnasium", "sapien.wrapper.urdf_loader"])
        with single_threaded():
            self._envs = gymnasium.vector.AsyncVectorEnv([lambda: _tutorial_env(setup)] * count, context="forkserver")
        self._actions = np.tile(setup.target, (count, 1))

    def reset(self) -> None:
        """Put the robots at the start."""
        self._envs.reset()

    def run(self, ticks: int) -> tuple[int, Float64]:
        """Step all envs tick by tick."""
        for _ in range(ticks):
            qpos = self._envs.step(self._actions)[0]
        return ticks * self._setup.substeps * self._count, qpos[0].astype(np.float64)

    def close(self) -> None:
        """End the processes."""
        self._envs.close()


def _tutorial_env(setup: Setup) -> Any:
    """The tutorial's loop as an env: the action is the target, a step is ``setup.substeps`` of the loop."""
    import gymnasium

    class TutorialEnv(gymnasium.Env):
        def __init__(self) -> None:
            self._loop = TutorialLoop(setup.robot, setup.target, start=setup.start)
            shape = setup.target.shape
            self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)
            self.action_space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float64)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
            super().reset(seed=seed)
            self._loop.reset(setup.start)
            return self._loop.robot.get_qpos(), {}

        def step(self, action: Float64) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            self._loop.target = action
            return self._loop.run(setup.substeps), 0.0, False, False, {}

    return TutorialEnv()


class MuJoCo:
    """MuJoCo's ``rollout`` on the same URDF, a thread for each worker.

    Joints are moved by its PD position actuators with the PID's kp and kd, gravity is compensated body by body, and
    there is a ground. Solver and integrator are MuJoCo's own: Newton, and "implicitfast", which it recommends.
    """

    def __init__(self, setup: Setup) -> None:
        import mujoco
        import mujoco.rollout

        robot, settings = setup.robot, setup.robot.settings
        assert settings is not None
        spec = mujoco.MjSpec.from_string(robot.urdf)
        spec.option.timestep = 1 / 2000
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
        for body in spec.bodies:
            body.gravcomp = 1
        for joint, kp, kd in zip(robot.joints, settings.kp, settings.kd, strict=True):
            actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            actuator.set_to_position(kp=kp, kv=kd)
        self._setup, self._model = setup, spec.compile()
        self._columns = [self._model.joint(name).qposadr[0] for name in robot.joint_names]
        self._kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        threads = max(setup.workers, 1)
        self._data = [mujoco.MjData(self._model) for _ in range(threads)]
        self._pool = mujoco.rollout.Rollout(nthread=threads)
        self._engine = mujoco
        self._state: Float64 = np.empty((0, 0))

    def reset(self) -> None:
        """Put the robots at the start."""
        data, size = self._data[0], self._engine.mj_stateSize(self._model, self._kind)
        self._engine.mj_resetData(self._model, data)
        data.qpos[self._columns] = self._setup.start
        row = np.empty(size)
        self._engine.mj_getState(self._model, data, row, self._kind)
        self._state = np.tile(row, (self._setup.num_envs, 1))

    def run(self, ticks: int) -> tuple[int, Float64]:
        """Step all envs, ``substeps`` at a time under one target."""
        setup = self._setup
        control = np.tile(setup.target, (setup.num_envs, setup.substeps, 1))
        for _ in range(ticks):
            states, _ = self._pool.rollout(self._model, self._data, self._state, control)
            self._state = states[:, -1]
        data = self._data[0]
        self._engine.mj_setState(self._model, data, self._state[0], self._kind)
        return ticks * setup.substeps * setup.num_envs, data.qpos[self._columns].copy()

    def close(self) -> None:
        """End the threads."""
        self._pool.close()


def run_peer(peer: Stepper, setup: Setup) -> tuple[float, int, Float64]:
    """Run one round of ``peer``: (seconds, env-steps, where the first env ended)."""
    peer.reset()
    began = time.perf_counter()
    steps, final = peer.run(setup.ticks)
    return time.perf_counter() - began, steps, final


PEERS = {
    "gymnasium, an env a core": Peer(
        "AsyncVectorEnv around the tutorial's loop, one env for each core",
        "gymnasium",
        lambda setup: AsyncVector(setup, max(setup.workers, 1)),
    ),
    "gymnasium, all envs": Peer(
        "the same, all envs at once, a process to each",
        "gymnasium",
        lambda setup: AsyncVector(setup, setup.num_envs),
    ),
    "mujoco": Peer(
        "MuJoCo's rollout on the same URDF, a thread a core: PD actuators, gravity compensation, its own solver",
        "mujoco",
        MuJoCo,
    ),
}


def installed() -> tuple[str, ...]:
    """Names of the peers whose package is there."""
    return tuple(name for name, peer in PEERS.items() if importlib.util.find_spec(peer.package) is not None)


def make_peer(name: str, setup: Setup) -> Stepper:
    """Build a peer.

    Raises
    ------
    MissingDependencyError
        Its package is not installed.
    """
    peer = PEERS[name]
    if importlib.util.find_spec(peer.package) is None:
        raise MissingDependencyError(peer.package, f"peer {name!r}", "peers")
    return peer.make(setup)
