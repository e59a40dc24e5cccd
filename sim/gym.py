"""Gymnasium: reach a drawn pose with N robots, joint setpoints as actions, the PID beside the physics.

``import sim.gym`` registers ``batchpid/Reach-v0`` for ``gymnasium.make_vec("batchpid/Reach-v0", num_envs=64)``;
``make_vec("sim.gym:batchpid/Reach-v0", ...)`` imports it by itself. Arrays are NumPy's, fresh at every step:
``jax.dlpack.from_dlpack`` and ``torch.from_dlpack`` take them without a copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from batchpid.errors import InvalidArgumentError, MissingDependencyError
from batchpid.validate import choice, integer, number
from sim.robot.robot import Robot
from sim.runner import Runner

try:
    import gymnasium
    from gymnasium import error, spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError:
    raise MissingDependencyError("gymnasium", "sim.gym", "gym") from None

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

ACTIONS = ("setpoint", "increment")
SPREAD = 0.1
"""How far from the robot's start pose an episode may begin [rad or m]."""
MARGIN = 0.05
"""Share of a joint's range at each end in which no goal is drawn."""
FASTEST = 100.0
"""The velocity at which PhysX stops every joint, and bound of the observed one [rad/s or m/s]."""


class ReachVectorEnv(VectorEnv):
    """N robots, each to reach a joint pose of its own: a :class:`gymnasium.vector.VectorEnv` over the Runner.

    - *Observation* (envs, 3 dof): qpos, qvel, goal [rad or m, and per second], clipped to the space.
    - *Action* (envs, dof) in [-1, 1]: the setpoint within the joint limits, or an increment of the setpoint.
    - *Reward*: minus the mean over joints of |goal - qpos| / range, plus 1 where every joint is within ``tolerance``.
    - *Terminated*: the env diverged (``info["diverged"]``), or reached its goal if ``terminate_on_success``.
    - *Truncated*: after ``max_episode_steps``.
    - *Info*: "success", "error" (largest |goal - qpos|), "diverged".

    Parameters
    ----------
    robot
        A bundled robot's name, a URDF path, or a :class:`sim.Robot`.
    rate_hz
        Actions per second; the PID runs at every sim step between.
    actions
        ``"setpoint"`` or ``"increment"``.
    max_increment
        An increment of 1 moves the setpoint so far, scalar or (dof,) [rad or m]; default the velocity limit times the
        time of a step.
    tolerance
        Largest error of a reached goal [rad or m].
    autoreset_mode
        Of :class:`gymnasium.vector.AutoresetMode`.
    options
        Of :class:`sim.Runner`: params, workers, timestep, physics, compensate, build, ...

    Raises
    ------
    InvalidArgumentError
        An argument is out of range.
    """

    def __init__(
        self,
        num_envs: int = 1,
        robot: str | Robot = "panda",
        *,
        rate_hz: float = 50.0,
        actions: str = "setpoint",
        max_increment: Any = None,
        tolerance: float = 0.02,
        terminate_on_success: bool = False,
        max_episode_steps: int | None = 250,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: None = None,
        **options: Any,
    ) -> None:
        self.robot = robot if isinstance(robot, Robot) else Robot.load(robot)
        self.num_envs = integer("num_envs", num_envs, 1, 1_000_000)
        self.actions = choice("actions", actions, ACTIONS)
        self.tolerance = number("tolerance", tolerance, 0.0, 1e3, "rad or m")
        self.terminate_on_success = terminate_on_success
        self.max_episode_steps = (
            None if max_episode_steps is None else integer("max_episode_steps", max_episode_steps, 1, 10**9)
        )
        if render_mode is not None:
            raise InvalidArgumentError(
                "render_mode", "is not offered", value=render_mode, remedy="watch robots with batchpid view"
            )
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        timestep = options.get("timestep", 1 / 2000)
        rate = number("rate_hz", rate_hz, 1e-3, 1 / timestep, "actions per second")

        far = np.pi
        self.low = np.where(np.isfinite(self.robot.lower), self.robot.lower, -far)
        self.high = np.where(np.isfinite(self.robot.upper), self.robot.upper, far)
        substeps = round(1 / (rate * timestep))
        increment = np.minimum(self.robot.velocity_limit, FASTEST) * substeps * timestep
        self.max_increment = np.broadcast_to(
            np.asarray(increment if max_increment is None else max_increment, np.float64), (self.robot.dof,)
        )
        fastest = np.full(self.robot.dof, FASTEST)
        self.single_observation_space = spaces.Box(
            np.concatenate([self.low - far, -fastest, self.low]).astype(np.float32),
            np.concatenate([self.high + far, fastest, self.high]).astype(np.float32),
        )
        self.single_action_space = spaces.Box(-1.0, 1.0, (self.robot.dof,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

        shape = (self.num_envs, self.robot.dof)
        self.runner = Runner(self.robot, self.num_envs, substeps=substeps, **options)
        self._generators = np.random.default_rng().spawn(self.num_envs)
        self._goal, self._setpoint = np.zeros(shape), np.zeros(shape)
        self._observation = np.zeros((self.num_envs, 3 * self.robot.dof), np.float32)
        self._steps = np.zeros(self.num_envs, np.int64)
        self._done = np.ones(self.num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        """Begin new episodes, in the envs of ``options["reset_mask"]`` or in all.

        An int ``seed`` gives env k the seed + k; a sequence has one for each env. What an env draws depends on its
        seed alone, not on its company.
        """
        mask = np.ones(self.num_envs, bool) if not options else options.get("reset_mask", np.ones(self.num_envs, bool))
        if (
            not isinstance(mask, np.ndarray)
            or mask.dtype != np.bool_
            or mask.shape != (self.num_envs,)
            or not mask.any()
        ):
            raise InvalidArgumentError(
                "options['reset_mask']",
                f"must be a bool array of shape ({self.num_envs},) with a True in it",
                remedy="use e.g. mask = terminated | truncated",
            )
        seeds = [seed + k for k in range(self.num_envs)] if isinstance(seed, int | np.integer) else seed
        if seeds is not None and len(seeds) != self.num_envs:
            raise InvalidArgumentError(
                "seed",
                f"has {len(seeds)} entries for {self.num_envs} envs",
                remedy="give an int, or one for each env",
            )
        for env in np.flatnonzero(mask).tolist():
            if seeds is not None and seeds[env] is not None:
                self._generators[env] = np.random.default_rng(seeds[env])
        self._begin(mask)
        return self._observation.copy(), self._info(mask)

    def step(self, actions: Any) -> tuple[Float32, NDArray[np.float64], Bool, Bool, dict[str, Any]]:
        """Let every robot follow its action for one step; arrays are (envs, ...)."""
        action = np.asarray(actions, np.float64)
        if action.shape != self._goal.shape or not np.isfinite(action).all():
            raise InvalidArgumentError(
                "actions",
                f"must be finite, of shape {self._goal.shape}",
                value=action.shape,
                remedy="see action_space",
            )
        begins = self._done.copy()
        if begins.any() and self.autoreset_mode is not AutoresetMode.NEXT_STEP:
            raise error.ResetNeeded(f"reset env {int(np.argmax(begins))} before the next step")
        action = np.clip(action, -1.0, 1.0)
        if self.actions == "setpoint":
            wanted = self.low + (action + 1) / 2 * (self.high - self.low)
        else:
            wanted = np.clip(self._setpoint + action * self.max_increment, self.low, self.high)
        self._setpoint = np.where(begins[:, None], self._setpoint, wanted)
        self._observe(self.runner.step(self._setpoint))
        self._steps += 1

        reward = 1.0 * self._success - (self._error / (self.high - self.low)).mean(1)
        terminated = self._diverged | (self._success & self.terminate_on_success)
        truncated = np.zeros(self.num_envs, bool)
        if self.max_episode_steps is not None:
            truncated = self._steps >= self.max_episode_steps
        if begins.any():  # next-step mode: this step of theirs begins the new episode
            self._begin(begins)
            reward, terminated, truncated = (
                np.where(begins, 0.0, reward),
                terminated & ~begins,
                truncated & ~begins,
            )
        self._done = terminated | truncated
        info = self._info(np.ones(self.num_envs, bool))
        if self._done.any() and self.autoreset_mode is AutoresetMode.SAME_STEP:
            done = self._done
            final = np.full(self.num_envs, None, object)
            for env in np.flatnonzero(done):
                final[env] = self._observation[env].copy()
            info = {
                "final_obs": final,
                "_final_obs": done,
                "final_info": self._info(done),
                "_final_info": done,
            }
            self._begin(done)
            info |= self._info(np.ones(self.num_envs, bool))
        return self._observation.copy(), reward, terminated, truncated, info

    def close_extras(self, **_: Any) -> None:
        """End the workers."""
        self.runner.close()

    # -- inside --------------------------------------------------------------------------------------------------

    def _begin(self, mask: Bool) -> None:
        """Draw start and goal of the envs of ``mask``, and place their robots."""
        start = np.array(self._setpoint)
        room = MARGIN * (self.high - self.low)
        for env in np.flatnonzero(mask).tolist():
            draw = self._generators[env]
            start[env] = self.robot.start + draw.uniform(-SPREAD, SPREAD, self.robot.dof)
            self._goal[env] = draw.uniform(self.low + room, self.high - room)
        start = np.clip(start, self.low, self.high)
        self._setpoint = np.where(mask[:, None], start, self._setpoint)
        self._steps[mask] = 0
        self._done = self._done & ~mask
        self._observe(self.runner.reset(start, mask=mask))

    def _observe(self, obs: Any) -> None:
        """Take in what the runner saw; an env that diverged keeps its last finite observation."""
        seen = np.concatenate([obs.qpos, obs.qvel, self._goal.astype(np.float32)], axis=1)
        space: Any = self.single_observation_space
        self._diverged = ~obs.ok
        self._observation = np.where(obs.ok[:, None], np.clip(seen, space.low, space.high), self._observation)
        self._error = np.abs(self._goal - self._observation[:, : self.robot.dof])
        self._success = obs.ok & (self._error <= self.tolerance).all(1)

    def _info(self, mask: Bool) -> dict[str, Any]:
        """Info in Gymnasium's vector style: a key, and under _key which envs it holds for."""
        values = {"success": self._success, "error": self._error.max(1), "diverged": self._diverged}
        info: dict[str, Any] = {}
        for key, value in values.items():
            info |= {key: np.where(mask, value, np.zeros_like(value)), f"_{key}": mask.copy()}
        return info


class ReachEnv(gymnasium.Env):
    """One robot of :class:`ReachVectorEnv`, for code that wants a plain environment. It runs in this process."""

    def __init__(self, robot: str | Robot = "panda", *, render_mode: None = None, **options: Any) -> None:
        options = {"workers": 0} | options
        self._envs = ReachVectorEnv(
            1,
            robot,
            max_episode_steps=None,
            autoreset_mode=AutoresetMode.DISABLED,
            render_mode=render_mode,
            **options,
        )
        self.metadata = {"render_modes": []}
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        """Begin a new episode."""
        super().reset(seed=seed)
        observation, info = self._envs.reset(seed=seed)
        return observation[0], self._single(info)

    def step(self, action: Any) -> tuple[Float32, float, bool, bool, dict[str, Any]]:
        """Let the robot follow its action for one step."""
        observation, reward, terminated, truncated, info = self._envs.step(np.asarray(action)[None])
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._single(info)

    def close(self) -> None:
        """Free the scene."""
        self._envs.close()

    @staticmethod
    def _single(info: dict[str, Any]) -> dict[str, Any]:
        return {key: value[0].item() for key, value in info.items() if not key.startswith("_")}


gymnasium.register(
    id="batchpid/Reach-v0",
    entry_point="sim.gym:ReachEnv",
    vector_entry_point="sim.gym:ReachVectorEnv",
    max_episode_steps=250,
)
