"""``batchpid tune`` and ``batchpid compare``: gains by simulation."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from batchpid.arrays.field_tables import Field
from batchpid.sim import Robot, tuning
from batchpid.sim.cli.flags import GAINS_FLAG, Randomize, flag
from batchpid.sim.options.groups import EngineName
from batchpid.sim.tuning.evaluation import load_randomization


def tune(
    robot: Robot,
    generations: Annotated[int, flag("Number of populations that the search evaluates.")] = 10,
    gain_units: Annotated[
        Literal["mass_matrix", "effort"],
        flag(
            "Gains per mass matrix (all joints respond equally fast), or as efforts (for any"
            " controller)."
        ),
    ] = "mass_matrix",
    randomize: Randomize = None,
    progress: Any = None,
) -> tuning.Tuning:
    """Tune the gains of any robot: design them from its inertia, then search by CMA-ES on simulated
    moves.

    The report is a table of the gains before and after, on moves that the search did not see.
    """
    return tuning.tune(
        robot,
        generations=generations,
        gain_units=gain_units,
        randomization=load_randomization(randomize, robot),
        progress=progress,
    )


def compare(
    robot: Robot,
    gains: Annotated[tuple[str, ...], GAINS_FLAG] = (),
    moves: Annotated[
        int,
        Field(low=1, high=100_000),
        flag("Number of random moves, the tutorial's aside."),
    ] = 20,
    engine: Annotated[
        tuple[EngineName, ...],
        flag("Physics engines, separated by a space: sapien, mujoco or both. Default: mujoco."),
    ] = (),
    randomize: Randomize = None,
    progress: Any = None,
) -> tuning.Comparison:
    """Compare sets of gains on the same seeded moves: settling, overshoot, final error and chatter
    of each.

    By default the sets are tuned, sapien-tutorial and drive for a bundled robot, else designed and
    drive. In two engines every set runs in both, on the same moves, and the report has the largest
    difference of their motions.
    """
    return tuning.compare(
        robot,
        gains,
        moves,
        engine=engine,
        randomization=load_randomization(randomize, robot),
        progress=progress,
    )
