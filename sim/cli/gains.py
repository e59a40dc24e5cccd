"""``batchpid tune`` and ``batchpid compare``: gains by simulation. ``batchpid export``: gains, or the
robot itself, as a file for another program.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np

from batchpid.arrays.field_tables import Field
from batchpid.checks import file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically
from batchpid.sim import Robot, tuning
from batchpid.sim.cli.flags import GAINS_FLAG, Gains, Randomize, flag
from batchpid.sim.options.groups import EngineName
from batchpid.sim.tuning.evaluation import load_randomization
from batchpid.sim.tuning.gain_sets import gain_set

if TYPE_CHECKING:
    import batchpid as bp
    from batchpid.export import Exported

ENDINGS = {
    "c": ".h",
    "ros2_control": ".yaml",
    "mjcf": ".xml",
    "urdf": ".urdf",
}
"""Suffix of the file of each target."""


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


@dataclass(frozen=True)
class ExportedFile:
    """File for a target, with its differences from batchpid's law or the robot's file."""

    target: str
    exported: Exported

    def report(self) -> str:
        """Return a line for each difference."""
        differences = self.exported.differences
        if not differences:
            return "The file has no differences."
        return "\n".join(f"differs: {text}" for text in differences)

    def save(self, path: Path) -> None:
        """Write the file."""
        file_path("out", path, (ENDINGS[self.target],))
        write_atomically(path, self.exported.text)


def export(
    robot: Robot,
    to: Annotated[Literal["c", "ros2_control", "mjcf", "urdf"], flag("Target.")] = "c",
    gains: Gains = None,
    timestep: Annotated[
        float,
        Field("seconds, not a rate: 1/1000", low=1e-6, high=1.0),
        flag("Time step of the control on the robot, or of the physics [s]."),
    ] = 1 / 1000,
    prefix: Annotated[
        str,
        flag("Beginning of every name in the file; in ros2_control the name of the controller."),
    ] = "batchpid",
) -> ExportedFile:
    """Write a robot's gains, or the robot itself, as a file for another program.

    Target "c" is a C99 header without dependencies: the law with its gains, bit-identical to
    batchpid's. "ros2_control" is the YAML of a controller. "mjcf" is the robot for MuJoCo, with
    motors, or with servos where --gains is given; "urdf" the robot with its repairs, without
    elements that have no effect here. Differences between the file and batchpid's law or the
    robot's file are printed, one line each.
    """
    # The robot alone, or the law.
    if to == "urdf":
        if gains is not None:
            problem = "has no effect with --to urdf"
            raise InvalidArgumentError("gains", problem, value=gains, remedy="leave it out")
        from batchpid.sim.robot.urdf_export import to_urdf

        return ExportedFile(to, to_urdf(robot))
    if to == "mjcf":
        return ExportedFile(to, _mjcf(robot, gains, timestep))
    # The law: its joints are all of them in C, and the leaders alone in ros2_control.
    from batchpid.export import to_c, to_ros2_control

    params = law_gains(robot, gains)
    leaders = robot.independent
    names = np.array(robot.joint_names)
    if to == "c":
        exported = to_c(
            params,
            timestep,
            joint_names=robot.joint_names,
            prefix=prefix,
        )
        place = "separate joints in the file; ignore their efforts"
    else:
        exported = to_ros2_control(
            params.for_joints(leaders),
            names[leaders].tolist(),
            timestep,
            name=prefix,
            inertia=_inertia(robot)[leaders],
        )
        place = "not in the file"
    if not leaders.all():
        text = f"{', '.join(names[~leaders])}: followers are {place}"
        exported = exported._replace(differences=(*exported.differences, text))
    return ExportedFile(to, exported)


def law_gains(robot: Robot, gains: str | None) -> bp.PIDParams:
    """Return the gains of the law by name; InvalidArgumentError for those of a drive."""
    chosen = gain_set(robot, gains)
    if chosen.control != "pid":
        remedy = "choose gains of the law: tuned, designed, sapien-tutorial, or a file"
        problem = "belong to a drive, and not to the law"
        raise InvalidArgumentError("gains", problem, value=chosen.name, remedy=remedy)
    return chosen.params


def _mjcf(robot: Robot, gains: str | None, dt: float) -> Exported:
    """Return the MJCF of the robot with motors, or with servos."""
    from batchpid.sim.engine.protocol import load_engine

    load_engine("mujoco")  # raises without MuJoCo
    from batchpid.sim.robot.mjcf_export import to_mjcf

    if gains is None:
        return to_mjcf(robot, None, dt)
    chosen = gain_set(robot, gains)
    params = chosen.params
    if chosen.control == "drive":
        # An engine's drive acts on its own velocities.
        params = params.replace(measurement_rate="measured")
    return to_mjcf(robot, params, dt, inertia=_inertia(robot))


def _inertia(robot: Robot) -> np.ndarray:
    """Return the inertia of the joints (dof,), 1 for followers, at the start pose."""
    matrix = robot.mass_matrix(robot.start)[0]
    return np.diagonal(robot.coupling.mass_matrix(matrix))
