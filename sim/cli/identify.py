"""``batchpid identify``: a robot's motors, friction and payload, found from logs. ``batchpid excite``: a
motion to record for it.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import tyro

from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically
from batchpid.sim import Robot
from batchpid.sim.cli.flags import flag
from batchpid.sim.diagnosis.causes import table
from batchpid.sim.identification.result import Identification
from batchpid.sim.options.groups import Compensation
from batchpid.trajectories import Trajectory

if TYPE_CHECKING:
    import batchpid as bp

EVALUATIONS = 45
"""Length of the bar: a fit usually ends before."""
THREADS = "scipy_openblas_set_num_threads64_"
"""Function of the OpenBLAS in NumPy's wheels."""


class Excitation(NamedTuple):
    """Motion that excites the joints of a robot."""

    robot: Robot
    motion: Trajectory

    def report(self) -> str:
        """Return the range and the largest speed of each joint."""
        motion = self.motion
        low = motion.position.min(0)
        high = motion.position.max(0)
        speed = np.abs(motion.velocity).max(0)
        joints = zip(self.robot.joint_names, self.robot.units, low, high, speed, strict=True)
        rows = [
            [name, f"{least:.3f} to {most:.3f} {unit}", f"{fastest:.3g} {unit}/s"]
            for name, unit, least, most, fastest in joints
        ]
        lines = [table(rows, ["joint", "moves from ... to", "fastest"], "lrr")]
        still = np.array(self.robot.joint_names)[low == high]
        if still.size:
            lines.append(
                f"\nToo weak for their friction and gravity, so they stay still: {', '.join(still)}."
            )
        lines.append(
            f"\n{motion.ticks} rows of {motion.time[0]:g} s; the robot starts at rest at the first row"
        )
        return "\n".join(lines)

    def save(self, path: Path) -> None:
        """Write the setpoints and their rates as CSV."""
        from batchpid.sim.recording.setpoint_files import setpoint_csv

        write_atomically(path, setpoint_csv(self.robot, self.motion))


def excite_joints(
    robot: Robot,
    seconds: Annotated[
        float, Field("s", low=1.0, high=3600.0), flag("Duration of the motion [s].")
    ] = 10.0,
) -> Excitation:
    """Make the motion to record for identification: a chirp of every joint.

    It keeps the limits of position, velocity and effort, and is free of contact. Writes setpoints
    and their rates as CSV with the header "time, setpoint:JOINT, ..., setpoint_rate:JOINT, ...",
    which `batchpid rollout --trajectory` follows. Move the robot to the first row before it starts,
    and add the measured positions to the log as qpos:JOINT.
    """
    from batchpid.sim.identification.excitation import excite

    return Excitation(robot, excite(robot, seconds))


def identify_logs(
    robot: Robot,
    logs: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        flag("Logs: .csv files or recordings (.h5)."),
    ] = (),
    gains: Annotated[
        str | None,
        flag(
            "Gains of the PID law that drove the robot: a params file (.yaml), or a name or"
            " file as for --gains of other commands. Without it a recording's own, or the logs'"
            " efforts.",
            "NAME|FILE",
        ),
    ] = None,
    compensate: Annotated[
        Compensation | None,
        flag(
            "Forces that the robot compensates: gravity+coriolis+friction, gravity+coriolis, gravity"
            " or none. Default: as a recording says, else gravity+coriolis+friction."
        ),
    ] = None,
    timestep: Annotated[
        float | None,
        Field("s", low=1e-5, high=0.01),
        flag(
            "Time step of the control that drove the robot [s]. Default: as a recording says, else the"
            " period of the rows up to 2.5 ms, or a part of a longer one of at most 0.5 ms."
        ),
    ] = None,
    hold: Annotated[
        bool,
        flag(
            "Commands hold from row to row of a log; otherwise they are interpolated. Recordings are"
            " always held."
        ),
    ] = False,
    no_payload: Annotated[bool, flag("The robot carries no payload.")] = False,
    extras: Annotated[
        tuple[str, ...],
        flag(
            "Further unknowns: load_friction, stribeck, offset, mass (of each link); with --gains"
            " also slew (the limit of the goal's rate)."
        ),
    ] = (),
    workers: Annotated[
        int,
        Field(low=0, high=1000),
        flag("Number of processes, 0 for none besides this one. The result does not depend on it."),
    ] = 0,
    force: bool = False,
    progress: Callable[[Any], Any] | None = None,
) -> Identification:
    """Identify a robot's motors from logs of its motion, from this robot or another simulator.

    Finds armature, damping, friction, strength and bias of each joint, the delays of efforts and
    setpoints, a lag of setpoints and a payload, by fitting simulated motions; writes them for
    --actuators of other commands. A log has a header and SI units: "time, setpoint:JOINT ..., qpos:JOINT ...",
    with the gains that drove the robot as --gains FILE, or "time, effort:JOINT ..., qpos:JOINT
    ...". The fit simulates a rigid-body model with a Runner's control and motors.
    """
    from batchpid.sim.identification.identification import identify

    _use_one_thread()
    # A fit ends when it has converged: the bar shows an upper bound.
    evaluations = iter(range(EVALUATIONS) if progress is None else progress(range(EVALUATIONS)))
    result = identify(
        robot,
        logs,
        None if gains is None else _gains(robot, gains),
        hold=hold,
        payload=not no_payload,
        compensate=compensate,
        timestep=timestep,
        extras=extras,
        workers=workers,
        progress=lambda: next(evaluations, None),
    )
    if result.explains or force:
        return result
    print(result.report())
    remedy = "--force writes the file nevertheless"
    raise InvalidArgumentError("logs", "are not explained, and no file is written", remedy=remedy)


def _use_one_thread() -> None:
    """Let NumPy's OpenBLAS use one thread: the others spin for a third of a fit's time."""
    library = ctypes.CDLL(find_spec("numpy._core._multiarray_umath").origin)  # type: ignore[union-attr]
    if hasattr(library, THREADS):
        getattr(library, THREADS)(1)


def _gains(robot: Robot, name: str) -> bp.PIDParams:
    """Return the gains of a name or file; a params file may have only the joints of the logs."""
    import batchpid as bp
    from batchpid.sim.tuning.gain_sets import gain_set

    if not Path(name).is_file():
        return gain_set(robot, name).params
    # The log may be of some joints: the file names them.
    joints = [joint for joint in robot.joint_names if joint in bp.load_params(name)[1]]
    return bp.load_params(name, joints)[0]
