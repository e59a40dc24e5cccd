"""Base class of tasks: N robots under a Runner as a vector environment of Gymnasium, with hooks for
the task.

Longer than 350 lines because one class is the whole environment, and documents every hook of a
task.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import error, spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from batchpid.arrays.array_types import Bool, Document, Float32, Float64, Rows
from batchpid.checks import array, check_keywords, choice, env_mask, flag, integer, number
from batchpid.errors import InvalidArgumentError, SingleOwner
from batchpid.plan import make_plan
from batchpid.sim.options.options import RunnerOptions, checked_option
from batchpid.sim.randomization.randomization import env_streams
from batchpid.sim.robot.robot import Robot
from batchpid.sim.runner.runner import Runner
from batchpid.sim.signals import Observation


class RobotVectorEnv(SingleOwner, VectorEnv, ABC):
    """Task of N robots: a :class:`gymnasium.vector.VectorEnv` over the Runner. A task is a subclass
    with hooks.

    This class has the spaces, seeds, episodes, autoreset, faults and randomization.
    The hooks define the task, in the order of a step. All but :meth:`spaces`, :meth:`observe` and
    :meth:`reward` have a default:

    - :meth:`spaces`: spaces of observation and action of one env; called once, before the runner
      starts;
    - :meth:`draw`: the start and the goal of an episode, drawn for one env;
    - :meth:`command`: the setpoint for an action;
    - :meth:`rate`: the rate of a setpoint that moves;
    - :meth:`observe`: the observation, made from the runner's;
    - :meth:`success`, :meth:`reward`, :meth:`terminated`, :meth:`info`: results, from the
      observation.

    Hooks get and return arrays with a row for each env. Each row may depend on that env alone, so
    that an episode is the same in any number of envs. An env that diverged keeps its last finite
    observation, is terminated, and its ``info["diverged"]`` is True.

    Parameters
    ----------
    num_envs
        Number of robots.
    robot
        Name of a bundled robot, URDF path, or :class:`batchpid.sim.Robot`.
    rate_hz
        Actions per second; the control runs at every sim step in between.
    terminate_on_success
        Whether an episode ends with success.
    max_episode_steps
        Steps after which an episode is truncated; None: never.
    autoreset_mode
        "NextStep": the step after the end of an episode begins the next one; "Disabled":
        ``reset(options={"reset_mask": terminated | truncated})`` does.
    render_mode
        ``"rgb_array"``: :meth:`render` returns pictures.
    chunk
        Rows of a chunk: an action of one env is then (chunk, size), ``rate_hz`` rows a second, which
        a plan executes (``plan=`` of the runner; default :func:`batchpid.make_plan` with a fade of
        half a step). None: no plan.
    execute
        Rows of a chunk that a step executes; default all.
    latency
        Least and largest time after which a chunk takes effect [s], at most the time of a step;
        drawn for each env and episode, and rounded up to whole rows, but less than a step.
    options
        Of :class:`batchpid.sim.Runner`, to which a task adds its own, such as ``control`` and
        ``build``.

    Raises
    ------
    InvalidArgumentError
        An argument is out of range or unknown.
    """

    instead = "make another env with the same arguments"
    metadata: ClassVar[Document] = {"render_modes": ["rgb_array"]}  # type: ignore[misc]

    robot: Robot
    """Robot of every env."""
    runner: Runner
    """Runner of the robots: ``runner.poses()``, ``runner.faults``, ... may be used in hooks."""
    step_seconds: float
    """Simulated time of a step [s]; in :meth:`spaces` that of a row, if there are chunks."""
    action: Float64
    """Last action (envs, size), within the action space; of a chunk the last row of the step."""
    setpoint: Float64
    """Setpoints at the end of the last step (envs, command size), from which the next action counts."""
    observed: Observation
    """Last observation of the runner: joint positions, velocities, efforts, ..."""

    def __init__(
        self,
        num_envs: int = 1,
        robot: str | Robot = "panda",
        *,
        rate_hz: float = 50.0,
        terminate_on_success: bool = False,
        max_episode_steps: int | None = 250,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        chunk: int | None = None,
        execute: int | None = None,
        latency: tuple[float, float] = (0.0, 0.0),
        **options: Any,
    ) -> None:
        if isinstance(robot, Robot):
            self.robot = robot
        else:
            self.robot = Robot.load(robot)
        self.num_envs = checked_option("num_envs", num_envs)
        self.terminate_on_success = flag("terminate_on_success", terminate_on_success)
        self.max_episode_steps = max_episode_steps
        if max_episode_steps is not None:
            integer("max_episode_steps", max_episode_steps, 1, 10**9)
        mode = getattr(autoreset_mode, "value", autoreset_mode)
        modes = [AutoresetMode.NEXT_STEP.value, AutoresetMode.DISABLED.value]
        self.autoreset_mode = AutoresetMode(choice("autoreset_mode", mode, modes))
        self.render_mode = render_mode
        if render_mode is not None:
            choice("render_mode", render_mode, self.metadata["render_modes"])
        # A step is a whole number of sim steps.
        if "substeps" in options:
            raise InvalidArgumentError("substeps", "follow from rate_hz", remedy="give rate_hz=")
        timestep = checked_option("timestep", options.get("timestep", RunnerOptions.timestep))
        rate = number("rate_hz", rate_hz, 1e-3, 1 / timestep, "actions per second")
        substeps = round(1 / (rate * timestep))
        self.step_seconds = substeps * timestep
        self._period, self._rows, self._ticks = self.step_seconds, chunk, 1
        # Spaces come first: an invalid one is an error before any process starts.
        self.single_observation_space, self.single_action_space = self.spaces()
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        action_shape = (self.num_envs, *(self.single_action_space.shape or ()))
        if chunk is not None:
            self._rows = integer("chunk", chunk, 1, 499)
            self._ticks = integer("execute", chunk if execute is None else execute, 1, chunk)
            self.step_seconds = self._ticks * self._period
            # Rows that passed during the latency are made up for in half a step, if need be behind
            # the last row, which is repeated.
            plan = make_plan(
                self.robot.dof,
                period=self._period,
                horizon=2 * self._rows + 1,
                fade=self.step_seconds / 2,
            )
            options = {"plan": plan, **options}
            box = self.single_action_space
            low, high = (np.tile(end, (self._rows, 1)) for end in (box.low, box.high))
            self.single_action_space = spaces.Box(low, high, dtype=box.dtype.type)
        elif execute is not None or np.any(latency):
            name = "latency" if execute is None else "execute"
            raise InvalidArgumentError(name, "has no effect without chunks", remedy="give chunk=")
        shortest, longest = latency
        self._latency = [
            number("latency", shortest, 0.0, longest, "s"),
            number("latency", longest, 0.0, self.step_seconds, "s"),
        ]
        self._waits = np.zeros(self.num_envs, np.int64)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.metadata = {  # type: ignore[misc]
            **type(self).metadata,
            "render_fps": 1 / self.step_seconds,
            "autoreset_mode": self.autoreset_mode,
        }
        self.runner = Runner(self.robot, self.num_envs, substeps=substeps, **options)
        self._generators = np.random.default_rng().spawn(self.num_envs)
        self._starts = np.tile(self.robot.start, (self.num_envs, 1))
        self.setpoint = np.zeros((self.num_envs, self.runner.command.size))
        self.action = np.zeros(action_shape)
        self._action_names: Sequence[str] = [str(column) for column in range(self.action.shape[1])]
        self._observation = np.zeros(self.observation_space.shape or (), np.float32)
        self._success = np.zeros(self.num_envs, bool)
        self._diverged = np.zeros(self.num_envs, bool)
        self._steps = np.zeros(self.num_envs, np.int64)
        self._done = np.ones(self.num_envs, bool)

    # -- hooks
    # ----------------------------------------------------------------------------------------------

    @abstractmethod
    def spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Return the spaces of the observation (n,) and of the action (size,) of one env.

        Attributes ``robot``, ``num_envs`` and ``step_seconds`` exist by now, ``runner`` does not.
        Actions are clipped to their space, and observations to theirs.
        """

    def draw(self, env: int, random: np.random.Generator) -> ArrayLike:
        """Draw an episode of one env: keep its goal, and return the joint positions at its start
        (dof,) [rad or m].

        ``random`` is the generator of this env, so that episodes depend on its seed alone. Default:
        ``robot.start``.
        """
        return self.robot.start

    def command(self, action: Float64, setpoint: Float64) -> ArrayLike:
        """Return the setpoints of the Runner (envs, command size) for the actions (envs, size).

        ``setpoint`` are the setpoints of the last step. With ``chunk`` each row of a chunk is an
        action, from the setpoints of the row before it; rows that are not executed count, too.
        Default: the action is the setpoint.
        """
        return action

    def rate(self, setpoint: Float64, last: Float64) -> ArrayLike | None:
        """Return the rates (envs, command size) per second at which the setpoints move from
        ``last`` to ``setpoint``.

        Increments move the setpoint over the whole step: their rate is the change by
        :attr:`step_seconds`. Without a rate, setpoints that move in every step are followed with a
        lag. None: setpoints are steps. Not called with ``chunk``: a plan makes the rates. Default:
        None.
        """
        return None

    @abstractmethod
    def observe(self, observed: Observation) -> ArrayLike:
        """Return the observations (envs, n) for the last observation of the runner.

        Poses of user content are ``self.runner.poses()`` (envs, entities, 7): the entities that
        ``build`` returned. It is one more message to each worker. Rows of envs that are not
        ``observed.ok`` are ignored.
        """

    def success(self, observation: Float32) -> ArrayLike:
        """Return whether each env has reached its goal (envs,). Default: no env has."""
        return np.zeros(self.num_envs, bool)

    @abstractmethod
    def reward(self, observation: Float32, success: Bool) -> ArrayLike:
        """Return the reward of each env (envs,)."""

    def terminated(self, observation: Float32, success: Bool) -> ArrayLike:
        """Return whether each env's episode ends (envs,); one that diverged always does.

        Default: with success, under ``terminate_on_success``.
        """
        return success & self.terminate_on_success

    def info(self, observation: Float32) -> Mapping[str, Rows]:
        """Return further entries of the info, arrays (envs,), between "success" and "diverged".
        Default: none.
        """
        return {}

    # -- the vector environment
    # ------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: Document | None = None
    ) -> tuple[Float32, Document]:
        """Begin new episodes, in the envs of ``options["reset_mask"]`` (envs,) or in all.

        An int ``seed`` gives env k the seed + k; a sequence has one for each env. What an env draws
        depends on its own seed alone, which is the stream of a ``randomization``, too.

        Raises
        ------
        InvalidArgumentError
            A seed is negative or no int, or an option is unknown.
        """
        options = options or {}
        check_keywords("reset(options=)", options, ("reset_mask",))
        mask = np.ones(self.num_envs, bool)
        if "reset_mask" in options:
            mask = env_mask("options['reset_mask']", options["reset_mask"], self.num_envs)
        seeds = None if seed is None else env_streams(seed, self.num_envs)
        self._begin(mask, seeds)
        return self._observation.copy(), self._info(mask)

    def step(self, actions: ArrayLike) -> tuple[Float32, Float64, Bool, Bool, Document]:
        """Apply an action (envs, size) for one step; return observation, reward, terminated,
        truncated and info.

        Raises
        ------
        gymnasium.error.ResetNeeded
            An episode has ended, and there is no autoreset.
        """
        space: Any = self.single_action_space
        shape = self.action_space.shape or ()
        action = array("actions", actions, shape, self._action_names, kind="entry")
        action = np.clip(action, space.low, space.high)
        begins, last = self._done, self.setpoint
        if begins.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise error.ResetNeeded(
                f"env {int(np.argmax(begins))} has ended; reset it before the next step"
            )
        rows, setpoints = [action], [last]
        if self._rows is not None:
            rows = list(action.swapaxes(0, 1))
        for row in rows:
            last = setpoints[-1]
            setpoints.append(self._returned("command", self.command(row, last), last.shape))
        # In next-step mode an ended env holds its setpoint: this step begins its next episode.
        setpoint = np.where(begins[:, None], last, setpoints[self._ticks])
        if self._rows is None:
            rate = self.rate(setpoint, last)
            if rate is not None:
                rate = np.where(begins[:, None], 0.0, rate)
            observed = self.runner.step(setpoint, setpoint_rate=rate)
        else:
            observed = self._execute(setpoints)
        self.action = rows[self._ticks - 1]
        self.setpoint = setpoint
        self._observe(observed)
        self._steps += 1
        observation, success = self._observation, self._success
        count = success.shape
        reward = self._returned("reward", self.reward(observation, success), count)
        ends = self._returned("terminated", self.terminated(observation, success), count, bool)
        terminated = self._diverged | ends
        truncated = np.zeros(count, bool)
        if self.max_episode_steps is not None:
            truncated = self._steps >= self.max_episode_steps
        if begins.any():
            # This step has no result for them.
            self._begin(begins)
            reward = np.where(begins, 0.0, reward)
            terminated = terminated & ~begins
            truncated = truncated & ~begins
        self._done = terminated | truncated
        info = self._info(np.ones(count, bool))
        return self._observation.copy(), reward, terminated, truncated, info

    def _execute(self, setpoints: list[Float64]) -> Observation:
        """Run the ticks of a step: the chunk of ``setpoints`` enters with its age."""
        assert self.runner.options.plan is not None
        held = self.runner.options.plan.horizon - len(setpoints)
        chunk = np.stack(setpoints + held * [setpoints[-1]], 1)
        waits = np.where(self._done, -1, self._waits)  # envs that begin get none
        for tick in range(self._ticks):
            age = np.where(waits == tick, tick * self._period, np.inf)
            observed = self.runner.step(chunk, latency=age)
        return observed

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a picture (height, width, 3) of each env, in RGB; None without a ``render_mode``.

        It shows robot and floor, not the content of ``build``.
        """
        if self.render_mode is None:
            return None
        from batchpid.sim.view.film import Painter

        painter = Painter(self.robot, 1, self.runner.options.ground, (640, 480))
        observed = self.runner.observe()
        pictures = []
        for env in range(self.num_envs):
            row = observed.for_envs([env])
            pictures.append(painter.picture(row.qpos, row.base_pose))
        return tuple(pictures)

    def close_extras(self, **_: object) -> None:
        """Close the runner."""
        self.runner.close()

    # -- episodes
    # ----------------------------------------------------------------------------------------------

    def _begin(self, mask: Bool, seeds: NDArray[np.int64] | None = None) -> None:
        """Draw episodes for the masked envs, of new ``seeds`` if there are any, and place their
        robots.
        """
        for env in np.flatnonzero(mask).tolist():
            if seeds is not None:
                self._generators[env] = np.random.default_rng(seeds[env])
            start = self.draw(env, self._generators[env])
            self._starts[env] = self._returned("draw", start, (self.robot.dof,))
            if self._latency[1] > 0:
                low, high = self._latency
                late = self._generators[env].uniform(low, high)
                self._waits[env] = min(np.ceil(late / self._period - 1e-9), self._ticks - 1)
        self._steps[mask] = 0
        self._done = self._done & ~mask
        if self.runner.options.randomization is None:
            seeds = None
        observed = self.runner.reset(self._starts, mask=mask, seed=seeds)
        first = self.runner.command.neutral
        if self.runner.options.sets_positions:
            first = observed.qpos
        self.setpoint = np.where(mask[:, None], first, self.setpoint)
        self._observe(observed)

    def _observe(self, observed: Observation) -> None:
        """Update observation and success; an env that diverged keeps its last finite
        observation.
        """
        space: Any = self.single_observation_space
        self.observed = observed
        self._diverged = ~observed.ok
        rows = self.observe(observed)
        shape = self._observation.shape
        rows = self._returned("observe", rows, shape, np.float32, observed.ok)
        rows = np.clip(rows, space.low, space.high)
        self._observation = np.where(observed.ok[:, None], rows, self._observation)
        success = self.success(self._observation)
        self._success = observed.ok & self._returned("success", success, observed.ok.shape, bool)

    def _returned(
        self,
        hook: str,
        value: ArrayLike,
        shape: tuple[int, ...],
        dtype: type = np.float64,
        mask: Bool | None = None,
    ) -> Rows:
        """Return a hook's value as an array; raise InvalidArgumentError for another shape, and for
        NaN or infinity in the envs of ``mask``.
        """
        rows = np.asarray(value)
        name = f"{type(self).__name__}.{hook}"
        if rows.shape != shape:
            problem = f"returned an array of shape {rows.shape}"
            raise InvalidArgumentError(name, problem, remedy=f"return one of shape {shape}")
        sound = np.isfinite(rows)
        if mask is not None:
            sound |= ~mask[:, None]
        if not sound.all():
            index = tuple(np.argwhere(~sound)[0].tolist())
            problem = f"returned a number that is not finite, at index {index}"
            raise InvalidArgumentError(name, problem, remedy="return finite numbers")
        return rows.astype(dtype, copy=False)

    def _info(self, mask: Bool) -> Document:
        """Return the info of the masked envs in Gymnasium's vector style: each key and, as _key,
        the mask.
        """
        info: Document = {}
        further = self.info(self._observation)
        for value in further.values():
            self._returned("info", value, mask.shape)
        values = {"success": self._success, **further, "diverged": self._diverged}
        for key, value in values.items():
            info[key] = value * mask
            info[f"_{key}"] = mask
        return info
