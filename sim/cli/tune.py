"""``batchpid tune``: gains that settle, found by simulation."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field, fields, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

import batchpid as bp
from batchpid.arrays.array_types import Document
from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import OutputFiles, bar, beside
from batchpid.sim.runner_keywords import DEFAULT_ENGINE
from batchpid.sim.tuning.cost import Weights
from batchpid.sim.tuning.gain_sets import GainSet
from batchpid.task_space import save_osc_options

if TYPE_CHECKING:
    from batchpid.sim.identification.confidence_region import DrawnMotors
    from batchpid.sim.tuning.evaluation import Within
    from batchpid.sim.tuning.search import Tuning

DRAWS, MOVES_WITHIN = 100, 1
"""Motors that ``--within`` draws, and random moves that are made with each, besides the tutorial's."""
FINALISTS_WITHIN, EVERY_DRAW = 6, 4
"""Number of candidates among which ``--within`` chooses; each is tried with every fourth draw."""
GENERATIONS, GENERATIONS_WITHIN = 10, 4
"""Generations of a search, and of one among drawn motors: the first one has gains for their delay."""
SUFFIXES = ".yaml", ".yml", ".json"
"""Formats of a params file."""

RUNNER = flags.runner_flags(*flags.SCENE_FLAGS)


@dataclass(frozen=True)
class TuneCommand:
    """Tune the gains of any robot: design them from its inertia, then search by CMA-ES on simulated moves.

    Ends with a table of the gains before and after, on moves that the search did not see, and writes the better params.
    """

    robot: flags.RobotName = "panda"
    control: Literal["pid", "osc"] = "pid"
    """Gains of the joints, or of operational-space control of a tool: bandwidths and damping ratios."""
    tool: Annotated[str | None, tyro.conf.arg(metavar="LINK", help_behavior_hint="")] = None
    """With --control osc: link to move. Default: the last one of the longest chain."""
    generations: Annotated[int | None, Field(low=1, high=100_000)] = None
    """Number of populations that the search evaluates. Default: 10; 4 with --within."""
    population: Annotated[int, Field(low=4, high=1000)] = 8
    """Candidates of a population, evaluated at once."""
    seed: flags.Seed = 0
    """Seed of the search and its moves. The result does not depend on the number of workers."""
    seconds: flags.MoveSeconds = 1.5
    """Simulated time of each move of the search [s]."""
    gain_units: Literal["mass_matrix", "inertia", "effort"] = "mass_matrix"
    """Gains per mass matrix (all joints respond equally fast), per joint inertia, or as efforts (for any
    controller)."""
    per_joint: flags.Switch = False
    """Search for a factor of each joint too; needs more generations."""
    weights: Annotated[Weights, tyro.conf.arg(name="")] = field(default_factory=Weights)
    randomize: flags.Randomize = None
    variation: flags.Variation = False
    payload: flags.Payload = 2.0
    friction: flags.Friction = 0.1
    engine: Annotated[Literal["sapien", "mujoco"] | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """Default: sapien; mujoco with --within, where it is installed."""
    runner: Annotated[flags.RunnerFlags, flags.group(RUNNER)] = field(default_factory=RUNNER)
    workers: flags.Workers = None
    cluster: flags.Cluster = None
    time_limit: flags.TimeLimit = None
    actuators: flags.Actuators = None
    within: flags.Switch = False
    """Tune for all motors in the confidence region that `batchpid identify` wrote into the file of --actuators: 100 are
    drawn, the worst counts, and what holds for all of them is printed."""
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    resume: flags.Switch = False
    """Continue a search with the same options that was stopped."""
    out: flags.OptionalPath = None
    """Params file to write: .yaml or .json. Default: out/ROBOT.tuned.yaml."""
    picture: flags.OptionalPath = None
    """Before and after on the first move, to draw: .png or .svg. Default: NAME-tune.png, next to the params file."""
    force: flags.Force = False

    imports = ("batchpid.sim.plots", "batchpid.sim.tuning.search")

    def run(self) -> None:
        """Run the command."""
        generations = GENERATIONS_WITHIN if self.within else GENERATIONS
        engine = "mujoco" if self.within and find_spec("mujoco") else DEFAULT_ENGINE
        known: Document = {"generations": generations, "engine": engine}
        replace(self, **{name: value for name, value in known.items() if getattr(self, name) is None})._run()

    def _run(self) -> None:
        """Run the command with all options known."""
        from batchpid.sim import plots
        from batchpid.sim.cli.report import draw_first_move, evaluation_table
        from batchpid.sim.cli.run import evaluate_sets, read_variation
        from batchpid.sim.tuning.evaluation import arm_joints
        from batchpid.sim.tuning.search import tune

        robot = Robot.load(self.robot, actuators=self.actuators, **vars(self.meshes))
        read = [Path(path) for path in (self.actuators, self.randomize) if path is not None]
        outputs = OutputFiles(force=self.force, inputs=read)
        named = self.out or Path("out") / robot.path.name
        if self.control == "osc":
            return self._tune_tool(robot, named, outputs)
        if self.tool is not None:
            raise InvalidArgumentError("tool", "is for --control osc", value=self.tool, remedy="leave it out")
        drawn = self._draw(robot)
        out = outputs.path("out", self.out or named.with_suffix(".tuned.yaml"), SUFFIXES)
        picture = outputs.path("picture", self.picture or beside(named, "tune"), plots.FORMATS)
        history = outputs.history(out.with_suffix(".search.json"), resume=self.resume)
        robot, randomization = read_variation(robot, self.randomize, flags.variation(self))
        found = tune(
            robot,
            seconds=self.seconds,
            randomization=randomization,
            history=history,
            motors=None if drawn is None else drawn.actuators,
            progress=bar("tuning", unit="generation"),
            **flags.chosen(self, "seed generations population gain_units per_joint weights time_limit"),
            **flags.chosen(self, "workers cluster engine") | self.runner.options(),
        )
        if drawn is not None:
            found = self._best_within(robot, found, drawn)
        print(
            f"{robot.name}: cost {found.start_cost:.4f} as designed, {found.cost:.4f} as tuned; weight of the settling "
            f"time {self.weights.settling:g}, of the following error {self.weights.following:g}\n"
        )
        sets = GainSet("designed", found.start_params), GainSet("tuned", found.params)
        options = flags.chosen(self, "seed workers cluster") | self.runner.options()
        evaluations = evaluate_sets(
            robot, sets, moves=20, randomization=randomization, engines=(self.engine or DEFAULT_ENGINE,), **options
        )
        print(evaluation_table(robot, evaluations))
        arm = arm_joints(robot)
        rejected, of_all = found.rejected or evaluations[1].drawback(evaluations[0], arm), None
        if drawn is not None:
            rejected, of_all = self._judge_within(robot, sets, drawn, rejected)
        chosen = 0 if rejected else 1
        judged = evaluations[chosen]
        worst, followed = judged.metrics.worst(), judged.following_error
        assert followed is not None  # evaluate_sets asks for it
        if rejected:
            print(f"\nThe designed gains are written, the tuned ones are rejected: {rejected}.")
        about = found.settings | {
            "cost": found.cost,
            "start_cost": found.start_cost,
            "gains": sets[chosen].name,
            **({"rejected": rejected} if rejected else {}),
            **({} if of_all is None else {"within": _figures(of_all)}),
            "judged": {
                "moves": len(judged.moves.start),
                "seed": self.seed + 1,
                "settling_time": float(worst.settling_time[arm].max()),
                "overshoot": float(worst.overshoot[arm].max()),
                "steady_state_error": float(worst.steady_state_error[arm].max()),
                "chatter": float(judged.chatter[:, arm].max()),
                "following_error": float(followed[:, arm].max()),
            },
        }
        bp.save_params(out, sets[chosen].params, robot.joint_names, about)
        history.unlink(missing_ok=True)
        print(f"\nwritten: {out}\npicture: {draw_first_move(robot, evaluations, picture)}")
        for text in judged.shortfalls(arm)[:5]:
            print(f"SHORT of the usual demands: {text}")
        print(f"next: {self._next_command(out)}")

    def _draw(self, robot: Robot) -> DrawnMotors | None:
        """Return the motors that ``--within`` draws; None without it."""
        if not self.within:
            return None
        from batchpid.sim.identification.confidence_region import draw_motors

        if self.actuators is None:
            remedy = "name the file of `batchpid identify` as --actuators"
            raise InvalidArgumentError("within", "needs a confidence region", remedy=remedy)
        return draw_motors(self.actuators, robot, DRAWS, self.seed)

    def _best_within(self, robot: Robot, found: Tuning, drawn: DrawnMotors) -> Tuning:
        """Return ``found`` with the candidate that is best with the worst of a part of the drawn motors.

        The search runs each move with a single draw, so its cost does not show the worst draw.
        """
        import numpy as np

        part = drawn.actuators.for_envs(np.arange(0, DRAWS, EVERY_DRAW))
        costs = np.sort(np.concatenate(found.history))[:FINALISTS_WITHIN]
        candidates = [found.ranked_params.for_envs([row]) for row in range(len(costs))]
        ranks = [self._within(robot, params, part).rank for params in candidates]
        best = ranks.index(min(ranks))
        return found._replace(params=candidates[best], cost=float(costs[best]))

    def _within(self, robot: Robot, params: bp.PIDParams, motors: bp.Actuators) -> Within:
        """Evaluate ``params`` with each row of ``motors`` on moves that the search does not make."""
        from batchpid.sim.tuning.evaluation import within
        from batchpid.sim.tuning.moves import random_moves, tutorial_move

        moves = tutorial_move(robot) + random_moves(robot, MOVES_WITHIN, self.seed + 1)
        options = flags.chosen(self, "workers cluster engine") | self.runner.options()
        return within(robot, params, motors, moves, **options)

    def _judge_within(
        self, robot: Robot, sets: tuple[GainSet, GainSet], drawn: DrawnMotors, rejected: str | None
    ) -> tuple[str | None, Within]:
        """Print figures that hold for all drawn motors; return them, after a reason if the designed gains are better.

        The designed gains are tried too where the search ``rejected`` the tuned ones, or these do not hold for all.
        """
        found = self._within(robot, sets[1].params, drawn.actuators)
        designed = None
        if rejected or not found.holds:
            designed = self._within(robot, sets[0].params, drawn.actuators)
        rejected = None
        if designed is not None and designed.rank < found.rank:
            worst = [
                f"{each.name} {of_all.settling.max():.3g} s"
                for each, of_all in zip(sets, (designed, found), strict=True)
            ]
            rejected, found = f"settling with the worst of the drawn motors: {', '.join(worst)}", designed
        print(f"\nwithin the confidence region of {self.actuators}, {DRAWS} draws of motors, in {self.engine}:")
        print("\n".join(f"  {line}" for line in within_report(robot, found, drawn)))
        return rejected, found

    def _tune_tool(self, robot: Robot, named: Path, outputs: OutputFiles) -> None:
        """Tune operational-space control: print a table and write the options."""
        from batchpid.sim.cli.report import cause_lines, gains_table
        from batchpid.sim.tuning.tool_search import tune_tool

        others = ("gain_units", "per_joint", "randomize", "variation", "cluster", "actuators", "within", "picture")
        flags.refuse(self, others, "is not available with --control osc")
        out = outputs.path("out", self.out or named.with_suffix(".osc.yaml"), SUFFIXES)
        history = outputs.history(out.with_suffix(".search.json"), resume=self.resume)
        found = tune_tool(
            robot,
            self.tool,
            seconds=self.seconds,
            history=history,
            progress=bar("tuning", unit="generation"),
            **flags.chosen(self, "seed generations population weights time_limit"),
            **flags.chosen(self, "workers engine") | self.runner.options(),
        )
        tool, (before, after) = found.settings["tool"], found.costs
        print(f"{robot.name}, {tool}: cost {before:.4f} by default, {after:.4f} as tuned\n")
        print(gains_table(("default", "tuned"), found.metrics))
        if found.rejected:
            print(f"\nThe default gains are written, the tuned ones are rejected: {found.rejected}.")
        if found.findings:
            print("\nNot settled under the gains written (each env makes one move):")
            print(*cause_lines(found.findings), sep="\n")
        save_osc_options(out, found.options, found.settings)
        history.unlink(missing_ok=True)
        print(f"\nwritten: {out}\nnext: {self._next_command(out)}")

    def _next_command(self, params: Path) -> str:
        """Return the command that runs the robot under the gains in the file ``params``, with the same options."""
        words = ["batchpid", "rollout", self.robot, "--gains", str(params)]
        if self.control == "osc":
            words += ["--control", "osc", *([] if self.tool is None else ["--tool", self.tool])]
        defaults = {each.name: each.default for each in fields(self)} | {"engine": DEFAULT_ENGINE}
        for name in ("randomize", "engine", "cluster", "actuators"):
            if (value := getattr(self, name)) != defaults[name]:
                words += [f"--{name}", str(value)]
        words += self.runner.words()
        if self.meshes.missing_meshes != "skip":
            words += ["--missing-meshes", self.meshes.missing_meshes]
        if self.meshes.package_dirs:
            words += ["--package-dirs", *map(str, self.meshes.package_dirs)]
        return shlex.join(words)


def within_report(robot: Robot, found: Within, drawn: DrawnMotors) -> list[str]:
    """Return lines that say what holds for all drawn motors."""
    import numpy as np

    stability, worst = found.stability, found.binding
    ratio, at = stability.robot_ratio, robot.joint_names[int(np.argmax(stability.participation))]
    where = f"with draw {stability.env} ({drawn.describe(stability.env, at)})"
    stable = "all are stable at their delay" if ratio < 1 else "NOT ALL ARE STABLE at their delay"
    never = int(np.isinf(found.settling).sum())
    settle = f"{never} DO NOT SETTLE" if never else "all settle"
    slowest, typical = found.settling.max(), np.median(found.settling)
    return [
        f"{stable}: at most {ratio:.2g} times the bound, by {at!r}, {where}",
        f"{settle}: within {slowest:.3g} s, half of them within {typical:.3g} s",
        f"binding corner: draw {worst}, joint {found.joints[worst]!r} in move {found.moves[worst]!r}: "
        f"{drawn.describe(worst, found.joints[worst])}",
    ]


def _figures(found: Within) -> Document:
    """Return what holds for all drawn motors, for the record."""
    return {
        "draws": len(found.settling),
        "holds": found.holds,
        "stability_ratio": found.stability.robot_ratio,
        "settling_time": float(found.settling.max()),
        "binding_draw": found.binding,
        "binding_joint": found.joints[found.binding],
    }
