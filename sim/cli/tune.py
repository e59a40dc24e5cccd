"""``batchpid tune``: gains that settle, found on the real scenes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from sim.cli.optional import OptionalFloat, OptionalInt, OptionalPath


@dataclass(frozen=True)
class Tune:
    """Tune the gains of any robot: from its inertia, then by CMA-ES on seeded moves, many candidates at once.

    Ends with a table of the gains before and after on moves that the search did not see, and writes the params.
    """

    robot: Annotated[str, tyro.conf.Positional] = "panda"
    """A bundled robot, or the path of a URDF."""
    generations: int = 10
    """How often the population is tried."""
    population: int = 8
    """Candidates tried at once."""
    seed: int = 0
    """Of the search and its moves. The result does not depend on the number of workers."""
    seconds: float = 1.5
    """Simulated time of each move [s]."""
    gain_units: Literal["mass_matrix", "inertia", "effort"] = "mass_matrix"
    """What the gains are per: with the mass matrix all joints respond alike; effort gains serve any controller."""
    per_joint: bool = False
    """Search for a factor of each joint too; needs more generations."""
    itae: float = 1.0
    """Weight of the time-weighted error."""
    settling: float = 1.0
    """Weight of the settling time."""
    overshoot: float = 1.0
    """Weight of the overshoot."""
    final: float = 2.0
    """Weight of the error left at the end."""
    chatter: float = 0.3
    """Weight of the effort's variation beyond the smooth move's."""
    saturation: float = 3.0
    """Weight of the time in saturation."""
    variation: bool = False
    """Payload, friction, coarse sensors and late efforts, drawn for each move."""
    payload: float = 2.0
    """With variation: the largest payload [kg], less where the robot does not carry it."""
    friction: float = 0.1
    """With variation: the largest joint friction (PhysX's coefficient)."""
    physics: Literal["accurate", "fast"] = "accurate"
    """Solver settings."""
    workers: OptionalInt = None
    """Processes; 0: this one. Default: one for each available core."""
    time_limit: OptionalFloat = None
    """Stop after the generation in which this many seconds have passed."""
    missing_meshes: Literal["error", "skip"] = "error"
    """Go on without collision shapes whose mesh is missing."""
    resume: bool = False
    """Go on where a search with the same options stopped."""
    out: OptionalPath = None
    """Params file to write: .yaml or .json. Default: out/ROBOT.tuned.yaml."""
    picture: OptionalPath = None
    """Before and after on the first move: .png or .svg. Default: beside the params."""

    def run(self) -> None:
        """Run it."""
        from batchpid import save_params
        from batchpid.errors import InvalidArgumentError
        from sim import Robot, plots
        from sim.cli.progress import bar
        from sim.cli.report import evaluation_table
        from sim.tuning.evaluation import arm_joints, evaluate_gains
        from sim.tuning.moves import random_moves, tutorial_move
        from sim.tuning.randomization import draw_variation
        from sim.tuning.search import Weights, tune

        robot = Robot.load(self.robot, missing_meshes=self.missing_meshes)
        out = Path(f"out/{robot.path.stem}.tuned.yaml") if self.out is None else self.out
        if out.suffix not in (".yaml", ".yml", ".json"):
            raise InvalidArgumentError("out", "unknown file format", value=str(out), remedy="end it in .yaml or .json")
        picture = plots.check_path(out.with_suffix(".png") if self.picture is None else self.picture)
        out.parent.mkdir(parents=True, exist_ok=True)
        history = out.with_suffix(".search.json")
        if not self.resume:
            history.unlink(missing_ok=True)
        varied: dict[str, Any] | None = None
        if self.variation:
            varied = {"payload": self.payload, "friction": self.friction}
        found = tune(
            robot,
            seed=self.seed,
            generations=self.generations,
            population=self.population,
            seconds=self.seconds,
            gain_units=self.gain_units,
            per_joint=self.per_joint,
            weights=Weights(self.itae, self.settling, self.overshoot, self.final, self.chatter, self.saturation),
            variation=varied,
            workers=self.workers,
            time_limit=self.time_limit,
            history=history,
            progress=bar("tuning", unit="generation"),
            physics=self.physics,
        )
        print(f"{robot.name}: cost {found.start_cost:.4f} as designed, {found.cost:.4f} as tuned\n")
        moves = tutorial_move(robot) + random_moves(robot, 20, self.seed + 1)
        drawn = None if varied is None else draw_variation(robot, len(moves.start), self.seed + 1, **varied)
        evaluations = [
            evaluate_gains(
                robot,
                params,
                moves,
                name=name,
                workers=self.workers,
                physics=self.physics,
                variation=drawn,
            )
            for name, params in bar("judging", unit="set")([("designed", found.start_params), ("tuned", found.params)])
        ]
        print(evaluation_table(robot, evaluations))
        arm = arm_joints(robot)
        worst = evaluations[1].metrics.worst()
        about = found.settings | {
            "cost": found.cost,
            "start_cost": found.start_cost,
            "judged": {
                "moves": len(moves.start),
                "seed": self.seed + 1,
                "settling_time": float(worst.settling_time[arm].max()),
                "overshoot": float(worst.overshoot[arm].max()),
                "steady_state_error": float(worst.steady_state_error[arm].max()),
                "chatter": float(evaluations[1].chatter[:, arm].max()),
            },
        }
        save_params(out, found.params, robot.joint_names, about)
        history.unlink(missing_ok=True)
        before, after = (plots.Traces.of(t.rollout.for_envs(slice(0, 1)), robot, t.name) for t in evaluations)
        image = plots.save(plots.comparison(before, after, title=f"{robot.name}, {moves.names[0]} move"), picture)
        print(f"\nwritten: {out}\npicture: {image}")
        for text in evaluations[1].shortfalls(arm)[:5]:
            print(f"SHORT of the usual demands: {text}")
