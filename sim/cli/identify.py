"""``batchpid identify``: a robot's motors, friction and payload, found from logs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import AT_MOST, FOLDER, OutputFiles, bar, beside, write_figures

if TYPE_CHECKING:
    import batchpid as bp

Logs = Annotated[
    tuple[Path, ...],
    tyro.conf.Positional,
    tyro.conf.arg(help="Logs: .csv, .h5, ROS bags (.bag, .mcap, folders) or recordings."),
]


@dataclass(frozen=True)
class IdentifyCommand:
    """Identify a robot's motors from logs of its motion, from this robot or another simulator.

    Finds armature, damping, friction, strength and bias of each joint, the delays of efforts and
    setpoints and the payload at the tool, by fitting simulated motions; writes them for --actuators
    of other commands. A log has a header and SI units: "time, setpoint:JOINT ..., qpos:JOINT ...",
    with the gains that drove the robot as --gains FILE, or "time, effort:JOINT ..., qpos:JOINT
    ...". The fit simulates a rigid-body model with a Runner's control and motors.
    """

    robot: flags.RobotName = "panda"
    logs: Logs = ()
    gains: Annotated[flags.OptionalName, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Gains of the PID law that drove the robot: a params file (.yaml or .json), or a name or file
    as for --gains of other commands. Without it a recording's own, or the logs' efforts.
    """
    compensate: Annotated[flags.Compensate | None, tyro.conf.arg(metavar="FORCES")] = None
    """Forces that the robot compensates: gravity+coriolis+friction, gravity+coriolis, gravity or
    none. Default: as the recordings say, else gravity+coriolis+friction.
    """
    timestep: Annotated[
        float | None, Field("s", low=1e-5, high=0.01), tyro.conf.arg(metavar="FLOAT")
    ] = None
    """Time step of the control that drove the robot [s]. Default: as the recordings say, else
    1/2000.
    """
    hold: flags.Switch = False
    """Commands hold from row to row of a log; otherwise they are interpolated. Recordings are
    always held.
    """
    degrees: flags.Switch = False
    """Positions and setpoints of revolute joints are in degrees."""
    topic: str = "/joint_states"
    """Topic of the measurements in a ROS bag (sensor_msgs/JointState), whose efforts count as
    measured.
    """
    command_topic: Annotated[flags.OptionalName, tyro.conf.arg(metavar="TOPIC")] = None
    """Topic of the commands in a ROS bag: positions are setpoints, efforts are efforts. Default:
    measured efforts.
    """
    prefix: str = ""
    """Prefix of the joints' names in the logs."""
    no_payload: flags.Switch = False
    """The tool carries no payload."""
    extras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = ()
    """Further unknowns: load_friction, stribeck, offset, mass (of each link); with --gains also
    gain (a factor of gains that are not known), kd, saturation and slew (the limit of the goal's
    rate).
    """
    workers: Annotated[int, Field(low=0, high=1000)] = 0
    """Number of processes, 0 for none besides this one. The result does not depend on it."""
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """Actuators file to write: .yaml or .json. Default: out/ROBOT.actuators.yaml."""
    json: flags.Json = None
    """Estimates with their 95 % intervals to write: .json."""
    corrected_urdf: flags.OptionalPath = None
    """URDF to write with the masses that were found with --extras mass: .urdf."""
    picture: flags.OptionalPath = None
    """Position errors before and after, to draw: .png or .svg. Default: NAME-fit.png, next to the
    actuators file."""
    force: flags.Force = False

    imports = ("batchpid.sim.plots", "batchpid.sim.identification.identification")

    def run(self) -> None:
        """Run the command."""
        import batchpid as bp
        from batchpid.io.files import write_atomically
        from batchpid.sim import plots
        from batchpid.sim.identification.identification import identify
        from batchpid.sim.identification.logs import Reading

        out = self.out or FOLDER / f"{Path(self.robot).stem}.actuators.yaml"
        outputs = OutputFiles(self)
        out = outputs.path("out", out, (".yaml", ".yml", ".json"))
        details = outputs.path("json", self.json, (".json",))
        corrected = outputs.path("corrected_urdf", self.corrected_urdf, (".urdf",))
        picture = outputs.path("picture", self.picture or beside(out, "fit"), plots.FORMATS)
        robot = Robot.load(self.robot, **vars(self.meshes))
        evaluations = iter(bar("identifying", bar_format=AT_MOST)(range(45)))
        result = identify(
            robot,
            self.logs,
            None if self.gains is None else _gains(robot, self.gains),
            payload=not self.no_payload,
            reading=Reading(**flags.chosen(self, "hold degrees topic command_topic prefix")),
            progress=lambda: next(evaluations, None),
            **flags.chosen(self, "compensate timestep extras workers"),
        )
        print(result.report())
        if not (result.explains or self.force):
            problem = (
                "are explained to less than half of the error of ideal motors, and no file is"
                " written"
            )
            raise InvalidArgumentError(
                "logs", problem, remedy=f"{result.advice}; --force writes the file nevertheless"
            )
        result.save(out)
        print(f"\nwritten: {out}")
        if (gains := result.gains()) is not None:
            path = beside(out, "gains").with_suffix(".yaml")
            bp.save_params(path, gains, [robot.joint_names[joint] for joint in result.joints])
            print(f"gains that were found, for --gains: {path}")
        if details is not None:
            write_figures(details, result.document())
            print(f"written: {details}")
        if corrected is not None:
            write_atomically(corrected, result.corrected_urdf())
            print(f"written: {corrected}")
        print(f"picture: {plots.save(result.figure(), picture)}")


def _gains(robot: Robot, name: str) -> bp.PIDParams:
    """Return the gains of a name or file; a params file may have only the joints of the logs."""
    import batchpid as bp
    from batchpid.sim.tuning.gain_sets import gain_set

    try:
        return gain_set(robot, name).params
    except InvalidArgumentError:
        if Path(name).suffix.lower() not in (".yaml", ".yml", ".json") or not Path(name).is_file():
            raise
        joints = [joint for joint in robot.joint_names if joint in bp.load_params(name)[1]]
        return bp.load_params(name, joints)[0]
