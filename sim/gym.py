"""Gymnasium environments: N robots reach random joint poses, with joint setpoints as actions.

``import batchpid.sim.gym`` registers ``batchpid/Reach-v0`` for ``gymnasium.make_vec("batchpid/Reach-v0",
num_envs=64)``; ``make_vec("batchpid.sim.gym:batchpid/Reach-v0", ...)`` does both. Arrays are NumPy's, new at every
step: ``jax.dlpack.from_dlpack`` and ``torch.from_dlpack`` take them without a copy.

Longer than 300 lines because one class is the whole environment: spaces, episodes, steps and autoreset.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.elementwise import TURN, wrap
from batchpid.checks.keywords import check_keywords
from batchpid.checks.single_owner import SingleOwner
from batchpid.checks.validate import AxisKind, array, choice, entries, env_mask, flag, integer, number
from batchpid.errors import BatchPIDError, CallOrderError, InvalidArgumentError, MissingDependencyError
from batchpid.sim.command import CommandSpec, own_command
from batchpid.sim.observation import Observation
from batchpid.sim.options import RunnerOptions
from batchpid.sim.robot.description import LIMIT_TOLERANCE
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner import Runner
from batchpid.sim.runner_keywords import RunnerKeywords

try:
    import gymnasium
    from gymnasium import error, spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError:
    raise MissingDependencyError("gymnasium", "batchpid.sim.gym", "gym") from None

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

ACTIONS = ("setpoint", "increment")
SPREAD = 0.1
"""Largest distance of a joint from the robot's start pose at the beginning of an episode [rad or m]."""
MARGIN = 0.05
"""Share of a joint's range, at each limit, in which no goal is drawn."""
MAX_SPEED = 100.0
"""Joint speed that PhysX allows, and bound of the observed one [rad/s or m/s]."""


class ReachVectorEnv(SingleOwner, VectorEnv):
    """N robots, each with a joint pose to reach: a :class:`gymnasium.vector.VectorEnv` over the Runner.

    Joints are the independent ones (:attr:`batchpid.sim.Robot.independent`): followers move with their leaders. A
    setpoint has one number for each of them. A :class:`batchpid.sim.Controller` may define another command, within the
    bounds of its :class:`batchpid.sim.CommandSpec`.

    - *Observation* (envs, 3 joints): qpos, qvel, goal [rad or m, and per second], clipped to the space.
    - *Action* (envs, size) in [-1, 1]: the setpoint within its limits, or an increment of the setpoint. An episode
      begins with the setpoint at the joints' pose, or with the ``neutral`` one of the command.
    - *Reward*: minus the mean over joints of |goal - qpos| / range, plus 1 where every joint is within ``tolerance``.
      A joint without a range counts as 0.
    - *Terminated*: the env diverged (``info["diverged"]``), or reached its goal if ``terminate_on_success``.
    - *Truncated*: after ``max_episode_steps``.
    - *Info*: "success", "error" (largest |goal - qpos|), "diverged".

    A continuous joint has the range [-pi, pi]. Its qpos and goal are observed in that range, its error is the short way
    round, and increments move it past pi if the law can (control "pid" with ``continuous`` in its params).
    Another joint without limits has the range of half a turn, or pi m, on either side of its start.

    Parameters
    ----------
    robot
        Name of a bundled robot, URDF path, or :class:`batchpid.sim.Robot`.
    rate_hz
        Actions per second; the PID runs at every sim step in between.
    actions
        ``"setpoint"`` or ``"increment"``.
    max_increment
        Change of the setpoint by an increment of 1, scalar or (size,) [rad or m]; default the velocity limit times the
        time of a step. No default for a controller that defines its command.
    tolerance
        Largest error of a reached goal [rad or m].
    autoreset_mode
        Of :class:`gymnasium.vector.AutoresetMode`.
    options
        Of :class:`batchpid.sim.Runner`: params, workers, timestep, physics, compensate, build, randomization, ...

    Raises
    ------
    InvalidArgumentError
        An argument is out of range.
    """

    instead = "make another env with the same arguments"

    def __init__(
        self,
        num_envs: int = 1,
        robot: str | Robot = "panda",
        *,
        rate_hz: float = 50.0,
        actions: str = "setpoint",
        max_increment: ArrayLike | None = None,
        tolerance: float = 0.02,
        terminate_on_success: bool = False,
        max_episode_steps: int | None = 250,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: None = None,
        **options: Any,
    ) -> None:
        check_keywords("ReachVectorEnv", options, RUNNER_OPTIONS + OWN_OPTIONS)
        self.robot = robot if isinstance(robot, Robot) else Robot.load(robot)
        self.num_envs = integer("num_envs", num_envs, 1, 1_000_000)
        self.actions = choice("actions", actions, ACTIONS)
        self.tolerance = number("tolerance", tolerance, 0.0, 1e3, "rad or m")
        self.terminate_on_success = flag("terminate_on_success", terminate_on_success)
        self.max_episode_steps = (
            None if max_episode_steps is None else integer("max_episode_steps", max_episode_steps, 1, 10**9)
        )
        if render_mode is not None:
            raise InvalidArgumentError(
                "render_mode", "is not supported", value=render_mode, remedy="watch robots with batchpid view"
            )
        modes = {mode.value: mode for mode in AutoresetMode}
        mode = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else autoreset_mode
        self.autoreset_mode = modes[choice("autoreset_mode", mode, modes)]
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        timestep = number("timestep", options.get("timestep", RunnerOptions.timestep), 1e-6, 0.1, "seconds")
        substeps = round(1 / (number("rate_hz", rate_hz, 1e-3, 1 / timestep, "actions per second") * timestep))

        self._independent = np.flatnonzero(self.robot.independent)
        lower, upper, fastest = (
            limit[self._independent] for limit in (self.robot.lower, self.robot.upper, self.robot.velocity_limit)
        )
        self.joint_names = tuple(self.robot.joint_names[joint] for joint in self._independent)
        continuous = self.robot.continuous[self._independent]
        self._turns = np.where(continuous, 1 / TURN, 0.0)
        self._start = wrap(self.robot.start[self._independent], self._turns, np)
        middle = np.where(continuous, 0.0, self._start)
        self.low = np.where(np.isfinite(lower), lower, middle - np.pi)
        self.high = np.where(np.isfinite(upper), upper, middle + np.pi)
        span = self.high - self.low
        self._span = np.where(span > LIMIT_TOLERANCE, span, np.inf)
        self._margin = np.where(continuous, 0.0, MARGIN * span)
        joints = len(self.joint_names)
        self._own = own = own_command(options.get("control"))
        self._setpoint_names, self._setpoint_low, self._setpoint_high = self.joint_names, self.low, self.high
        if own is not None:
            self._setpoint_names = own.names
            self._setpoint_low, self._setpoint_high = _finite_bounds(own)
        if max_increment is None:
            if own is not None and self.actions == "increment":
                remedy = f"give one number for each of {', '.join(own.names)}"
                raise InvalidArgumentError("max_increment", "is needed for the command of this control", remedy=remedy)
            max_increment = 0.0 if own is not None else np.minimum(fastest, MAX_SPEED) * substeps * timestep
        size = len(self._setpoint_names)
        self._kind: AxisKind = "joint" if own is None else "entry"
        self.max_increment = array("max_increment", max_increment, (1, size), self._setpoint_names, kind=self._kind)[0]
        speed = np.full(joints, MAX_SPEED)
        beyond = np.where(continuous, 0.0, np.pi)
        self.single_observation_space = spaces.Box(
            np.concatenate([self.low - beyond, -speed, self.low]).astype(np.float32),
            np.concatenate([self.high + beyond, speed, self.high]).astype(np.float32),
        )
        self.single_action_space = spaces.Box(-1.0, 1.0, (size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

        self.runner = Runner(self.robot, self.num_envs, substeps=substeps, **options)
        law = self.runner.params.continuous if self.runner.control == "pid" else None
        turns = np.zeros(self.robot.dof) if law is None else np.asarray(law, np.float64).min(0) / TURN
        joint_turns = np.minimum(self._turns, turns[self._independent])
        self._setpoint_turns = joint_turns if own is None else np.zeros(size)
        self._generators = np.random.default_rng().spawn(self.num_envs)
        self._goal, self._setpoint = np.zeros((self.num_envs, joints)), np.zeros((self.num_envs, size))
        self._observation = np.zeros((self.num_envs, 3 * joints), np.float32)
        self._steps = np.zeros(self.num_envs, np.int64)
        self._done = np.ones(self.num_envs, bool)
        self._is_stepping = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        """Begin new episodes, in the envs of ``options["reset_mask"]`` (envs,) or in all.

        An int ``seed`` gives env k the seed + k; a sequence has one for each env, or None to go on with the last. What
        an env draws depends on its own seed alone, which is the stream of a ``randomization``, too.

        Raises
        ------
        CallOrderError
            A step was begun and has not been waited for.
        """
        self._expect_no_step("reset")
        mask = np.ones(self.num_envs, bool)
        if options and "reset_mask" in options:
            mask = env_mask("options['reset_mask']", options["reset_mask"], self.num_envs)
        if not mask.any():
            raise InvalidArgumentError(
                "options['reset_mask']", "selects no env", remedy="use e.g. mask = terminated | truncated"
            )
        seeds = range(seed, seed + self.num_envs) if isinstance(seed, int | np.integer) else seed
        if seeds is not None and len(seeds) != self.num_envs:
            raise InvalidArgumentError(
                "seed", f"has {len(seeds)} entries for {self.num_envs} envs", remedy="give an int, or one for each env"
            )
        streams: dict[int, int] = {}
        for env in np.flatnonzero(mask).tolist():
            if seeds is not None and (stream := seeds[env]) is not None:
                self._generators[env], streams[env] = np.random.default_rng(stream), stream
        self._begin(mask, streams)
        return self._observation.copy(), self._info(mask)

    def step(self, actions: ArrayLike) -> tuple[Float32, NDArray[np.float64], Bool, Bool, dict[str, Any]]:
        """Apply an action (envs, size) for one step; return observation, reward, terminated, truncated and info."""
        self.step_async(actions)
        return self.step_wait()

    def step_async(self, actions: ArrayLike) -> None:
        """Begin a step, which the workers make while the caller computes something else, and return.

        Raises
        ------
        CallOrderError
            The last step that was begun has not been waited for.
        """
        self._expect_no_step("step_async")
        shape, low, high = self._setpoint.shape, self._setpoint_low, self._setpoint_high
        action = np.clip(array("actions", actions, shape, self._setpoint_names, kind=self._kind), -1.0, 1.0)
        begins = self._done.copy()
        if begins.any() and self.autoreset_mode is not AutoresetMode.NEXT_STEP:
            raise error.ResetNeeded(f"reset env {int(np.argmax(begins))} before the next step")
        if self.actions == "setpoint":
            setpoint = low + (action + 1) / 2 * (high - low)
        else:
            setpoint = self._setpoint + action * self.max_increment
            setpoint = np.clip(wrap(setpoint, self._setpoint_turns, np), low, high)
        setpoint = np.where(begins[:, None], self._setpoint, setpoint)
        self.runner.send(self._of_robot(setpoint) if self._own is None else setpoint)
        self._setpoint, self._is_stepping = setpoint, True

    def step_wait(self) -> tuple[Float32, NDArray[np.float64], Bool, Bool, dict[str, Any]]:
        """Wait for the step that :meth:`step_async` began; return what :meth:`step` returns.

        Raises
        ------
        CallOrderError
            No step was begun.
        """
        if not self._is_stepping:
            raise CallOrderError("step_wait: no step is under way; call step_async(actions) first")
        try:
            observation = self.runner.recv()
        except BatchPIDError:  # the step has ended; after an interrupt, in contrast, the call can be repeated
            self._is_stepping = False
            raise
        self._is_stepping = False
        self._observe(observation)
        begins = self._done.copy()
        self._steps += 1

        reward = 1.0 * self._success - (self._error / self._span).mean(1)
        terminated = self._diverged | (self._success & self.terminate_on_success)
        truncated = self._steps >= (np.inf if self.max_episode_steps is None else self.max_episode_steps)
        if begins.any():  # in next-step mode this step begins the next episode
            self._begin(begins)
            reward[begins] = 0.0
            terminated, truncated = terminated & ~begins, truncated & ~begins
        self._done = terminated | truncated
        everywhere = np.ones(self.num_envs, bool)
        info = self._info(everywhere)
        if self._done.any() and self.autoreset_mode is AutoresetMode.SAME_STEP:
            done = self._done
            final = np.full(self.num_envs, None, object)
            for env in np.flatnonzero(done):
                final[env] = self._observation[env].copy()
            info = {"final_obs": final, "_final_obs": done, "final_info": self._info(done), "_final_info": done}
            self._begin(done)
            info |= self._info(everywhere)
        return self._observation.copy(), reward, terminated, truncated, info

    def close_extras(self, **_: Any) -> None:
        """Close the runner."""
        self.runner.close()

    def _begin(self, mask: Bool, streams: Mapping[int, int] | None = None) -> None:
        """Draw start and goal of the masked envs, and place their robots; ``streams`` are new ones of some envs."""
        start = np.tile(self._start, (self.num_envs, 1))
        for env in np.flatnonzero(mask).tolist():
            generator = self._generators[env]
            drawn = self._start + generator.uniform(-SPREAD, SPREAD, len(self.joint_names))
            start[env] = np.clip(wrap(drawn, self._turns, np), self.low, self.high)
            self._goal[env] = generator.uniform(self.low + self._margin, self.high - self._margin)
        first = start if self._own is None else np.asarray(self._own.neutral)
        self._setpoint = np.where(mask[:, None], first, self._setpoint)
        self._steps[mask] = 0
        self._done = self._done & ~mask
        qpos, seeds = self._of_robot(start), np.zeros(self.num_envs, np.int64)
        if streams and self.runner.options.randomization is not None:
            seeded = np.isin(np.arange(self.num_envs), list(streams))
            seeds[list(streams)] = list(streams.values())
            self._observe(self.runner.reset(qpos, mask=seeded, seed=seeds))
            mask = mask & ~seeded
        if mask.any():
            self._observe(self.runner.reset(qpos, mask=mask))

    def _of_robot(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return positions (envs, joints) of the independent joints for all joints of the robot (envs, dof)."""
        rows = np.zeros((self.num_envs, self.robot.dof))  # the runner puts followers in place
        rows[:, self._independent] = positions
        return rows

    def _observe(self, observed: Observation) -> None:
        """Update the observation; an env that diverged keeps its last finite one."""
        space: Any = self.single_observation_space
        qpos = wrap(observed.qpos[:, self._independent].astype(np.float64), self._turns, np)
        joined = np.concatenate([qpos, observed.qvel[:, self._independent], self._goal], axis=1).astype(np.float32)
        self._diverged = ~observed.ok
        self._observation = np.where(observed.ok[:, None], np.clip(joined, space.low, space.high), self._observation)
        self._error = np.abs(wrap(self._goal - self._observation[:, : len(self.joint_names)], self._turns, np))
        self._success = observed.ok & (self._error <= self.tolerance).all(1)

    def _expect_no_step(self, call: str) -> None:
        """Raise CallOrderError if a step has begun and has not been waited for."""
        if self._is_stepping:
            raise CallOrderError(f"{call}: a step is under way; call step_wait() first")

    def _info(self, mask: Bool) -> dict[str, Any]:
        """Return the info of the masked envs in Gymnasium's vector style: each key and, as _key, the mask."""
        values = {"success": self._success, "error": self._error.max(1), "diverged": self._diverged}
        info = {key: np.where(mask, value, np.zeros_like(value)) for key, value in values.items()}
        return info | {f"_{key}": mask.copy() for key in values}


def _finite_bounds(command: CommandSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the bounds of a command; raise InvalidArgumentError if one is infinite."""
    low, high = np.asarray(command.lower), np.asarray(command.upper)
    good, remedy = (
        np.isfinite(low) & np.isfinite(high),
        "let its command be a batchpid.sim.CommandSpec with lower= and upper=",
    )
    entries("control", low, good, "has no bounds", command.names, kind="entry", remedy=remedy)
    return low, high


OWN_OPTIONS = tuple(inspect.signature(ReachVectorEnv).parameters)[:-1]
"""Arguments of :class:`ReachVectorEnv`, without the options of the runner."""
RUNNER_OPTIONS = tuple({"params", *RunnerKeywords.__annotations__} - {"substeps"})
"""Options of the runner, without ``substeps``, which follow from ``rate_hz``."""


class ReachEnv(SingleOwner, gymnasium.Env):
    """One robot of :class:`ReachVectorEnv` as a :class:`gymnasium.Env`, by default in this process."""

    instead = ReachVectorEnv.instead

    def __init__(self, robot: str | Robot = "panda", *, render_mode: None = None, **options: Any) -> None:
        fixed = ("num_envs", "max_episode_steps", "autoreset_mode")
        check_keywords("ReachEnv", options, [name for name in OWN_OPTIONS + RUNNER_OPTIONS if name not in fixed])
        options |= {"workers": options.get("workers", 0), "autoreset_mode": AutoresetMode.DISABLED}
        self._envs = ReachVectorEnv(1, robot, max_episode_steps=None, render_mode=render_mode, **options)
        self.runner = self._envs.runner
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32, dict[str, Any]]:
        """Begin a new episode."""
        super().reset(seed=seed)
        observation, info = self._envs.reset(seed=seed)
        return observation[0], self._single(info)

    def step(self, action: ArrayLike) -> tuple[Float32, float, bool, bool, dict[str, Any]]:
        """Apply an action (size,) for one step; return observation, reward, terminated, truncated and info."""
        observation, reward, terminated, truncated, info = self._envs.step(np.asarray(action)[None])
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), self._single(info)

    def close(self) -> None:
        """Close the runner."""
        self._envs.close()

    @staticmethod
    def _single(info: dict[str, Any]) -> dict[str, Any]:
        """Return the info of the first env."""
        return {key: value[0].item() for key, value in info.items() if not key.startswith("_")}


gymnasium.register(
    "batchpid/Reach-v0",
    "batchpid.sim.gym:ReachEnv",
    max_episode_steps=250,
    vector_entry_point="batchpid.sim.gym:ReachVectorEnv",
)
