"""``batchpid identify``: a robot's motors, friction and payload, found from logs."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from batchpid.arrays.field_tables import Field
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.cli import flags
from batchpid.sim.cli.outputs import AT_MOST, FOLDER, OutputFiles, bar, beside, write_figures

if TYPE_CHECKING:
    from batchpid.sim.identification.log import Log
    from batchpid.sim.identification.result import Identification

OF_FIT = ("no_payload", "extras", "seed", "workers", "corrected_urdf", "picture")
"""Options that a fit alone has, besides its files."""
Logs = Annotated[
    tuple[Path, ...],
    tyro.conf.Positional,
    tyro.conf.arg(help="Logs: .csv, .h5, ROS bags (.bag, .mcap, folders) or recordings; or a list of logs (.yaml)."),
]


@dataclass(frozen=True)
class IdentifyCommand:
    """Identify a robot's motors from logs of its motion, from this robot or another simulator.

    Finds armature, damping, friction, strength and bias of each joint, the delay of the commands and the payload at the
    tool, by fitting simulated motions; writes them for --actuators of other commands. A log has a header and SI units:
    "time, setpoint:JOINT ..., qpos:JOINT ...", with the gains that drove the robot as --gains FILE, or
    "time, effort:JOINT ..., qpos:JOINT ...". There is no --engine: the fit simulates a separate rigid-body
    model, with the equations and time steps of both engines.
    """

    robot: flags.RobotName = "panda"
    logs: Logs = ()
    gains: Annotated[flags.OptionalName, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Gains of the PID law that drove the robot: a params file (.yaml or .json), or a name or file as for --gains of
    other commands. Without it the logs' efforts are used."""
    compensate: Annotated[flags.Compensate | None, tyro.conf.arg(metavar="FORCES")] = None
    """Forces that the robot compensates: gravity+coriolis+friction, gravity+coriolis, gravity or none. Default: as the
    recordings say, else gravity+coriolis+friction."""
    timestep: Annotated[float | None, Field("s", low=1e-5, high=0.01), tyro.conf.arg(metavar="FLOAT")] = None
    """Time step of the control that drove the robot [s]. Default: as the recordings say, else 1/2000."""
    sim_steps: Annotated[int, Field(low=1, high=100)] = 1
    """Sim steps in each control step: about 4 for a robot under control at 500 Hz, or its hold counts as delay."""
    hold: flags.Switch = False
    """Commands hold from row to row of a log; otherwise they are interpolated. Recordings are always held."""
    measured: Annotated[Literal["motor", "link"] | None, tyro.conf.arg(metavar="motor|link")] = None
    """The efforts of the logs were measured, at the motor (as its current) or behind the gear, and not commanded. A
    file may have both: effort:JOINT and measured_effort:JOINT."""
    time_unit: Annotated[Literal["s", "ms", "us", "ns"] | None, tyro.conf.arg(metavar="s|ms|us|ns")] = None
    """Unit of the times. Default: as the column's name says (time_ms, time_ns), else seconds."""
    degrees: flags.Switch = False
    """Positions, setpoints and velocities of revolute joints are in degrees."""
    topic: str = "/joint_states"
    """Topic of the measurements in a ROS bag (sensor_msgs/JointState), whose efforts count as measured."""
    command_topic: Annotated[flags.OptionalName, tyro.conf.arg(metavar="TOPIC")] = None
    """Topic of the commands in a ROS bag: positions are setpoints, efforts are efforts. Default: measured efforts."""
    prefix: str = ""
    """Prefix of the joints' names in the logs."""
    no_payload: flags.Switch = False
    """The tool carries no payload."""
    extras: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = ()
    """Effects to try, each kept where the error on the held-out part falls: load_friction, stribeck, offset; with
    --gains also gain (a factor of gains that are not known), kd, saturation and slew (the limit of the goal's rate)."""
    evaluations: Annotated[int, Field(high=1000)] = 25
    """Largest number of evaluations of the fit; each simulates the robot along the logs and, for each unknown,
    a perturbed one, so that a minute of logs takes six times as long as ten seconds. 0: no fit; with --actuators their
    error is printed, and without them strength, delay and lag are found from efforts that are commanded and measured,
    without a model of the robot."""
    actuators: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """With --evaluations 0: an actuators file whose error on the held-out part is printed. Nothing is fitted or
    written."""
    seed: flags.Seed = 0
    """Seed of CMA-ES, which finds the start of the fit. The result does not depend on the number of workers."""
    workers: flags.Workers = None
    meshes: flags.Meshes = field(default_factory=flags.MeshOptions)
    out: flags.OptionalPath = None
    """Actuators file to write: .yaml or .json. Default: out/ROBOT.actuators.yaml."""
    json: flags.Json = None
    """Estimates with their 95 % intervals to write: .json."""
    corrected_urdf: flags.OptionalPath = None
    """URDF to write with the masses of the links that seem heavier or lighter than described: .urdf. Identify again
    with it."""
    picture: flags.OptionalPath = None
    """Position errors before and after, to draw: .png or .svg. Default: NAME-fit.png, next to the
    actuators file."""
    force: flags.Force = False

    imports = (
        "batchpid.sim.plots",
        "batchpid.sim.robot.robot_model",
        "batchpid.sim.identification.identification",
    )

    def run(self) -> None:
        """Run the command."""
        import batchpid as bp
        from batchpid.io.files import write_atomically
        from batchpid.sim import plots
        from batchpid.sim.identification.identification import identify
        from batchpid.sim.identification.log_lists import gains_of

        if not self.logs:
            raise InvalidArgumentError("logs", "are missing", remedy="name one file or more after the robot")
        out = self.out or FOLDER / f"{Path(self.robot).stem}.actuators.yaml"
        outputs = OutputFiles(self)
        out = outputs.path("out", out, (".yaml", ".yml", ".json"))
        details = outputs.path("json", self.json, (".json",))
        corrected = outputs.path("corrected_urdf", self.corrected_urdf, (".urdf",))
        picture = outputs.path("picture", self.picture or beside(out, "fit"), plots.FORMATS)
        robot = Robot.load(self.robot, **vars(self.meshes))
        if self.actuators is not None:
            return self._judge(robot, self.actuators)
        params = None if self.gains is None else gains_of(robot, self.gains)
        logs = self._logs(robot)
        if self.evaluations == 0:
            return self._compare_efforts(robot, logs, out, details)
        note = "first a search for the start of the fit, then the fit; both take longer the longer the logs are"
        print(f"{robot.name}: {note}", flush=True)
        found = identify(
            robot,
            logs,
            params=params,
            payload=not self.no_payload,
            **flags.chosen(self, "compensate timestep sim_steps hold extras evaluations seed workers"),
            progress=bar("identifying", bar_format=AT_MOST),
        )
        print(report(found))
        if not found.explains:
            problem = "are not explained: the error on the held-out part did not fall, and no file is written"
            remedy = f"check --gains, --timestep and --compensate, and the columns of {found.worst_joint!r}"
            raise InvalidArgumentError("logs", problem, remedy=remedy)
        found.save(out)
        print(f"\nwritten: {out}")
        if found.finds_gains and (gains := found.gains()) is not None:
            path = beside(out, "gains").with_suffix(".yaml")
            bp.save_params(path, gains, [robot.joint_names[joint] for joint in found.joints])
            print(f"gains that were found, for --gains: {path}")
        if details is not None:
            write_figures(details, found.document())
            print(f"written: {details}")
        if corrected is not None and found.diagnosis.links:
            write_atomically(corrected, found.corrected_urdf())
            print(f"written: {corrected}; identify again with it")
        elif corrected is not None:
            print(f"not written: {corrected}; no link's mass seems off")
        names, units = ([table[joint] for joint in found.joints] for table in (robot.joint_names, robot.units))
        errors = [plots.FitErrors(*fit[1:]) for fit in found.fits if fit.log == 0]
        title = f"{robot.name}: position error, shaded where it was not fitted"
        print(f"picture: {plots.save(plots.fit_errors(errors, names, units, title), picture)}")

    def _judge(self, robot: Robot, actuators: Path) -> None:
        """Print the error of an actuators file."""
        from batchpid.sim.identification.held_out import held_out_error
        from batchpid.sim.identification.log_lists import gains_of

        if self.evaluations:
            remedy = "add --evaluations 0 to print the error of the file, or leave it out to fit"
            raise InvalidArgumentError("actuators", "are not the start of a fit", value=actuators, remedy=remedy)
        flags.refuse(self, (*OF_FIT, "out", "json"), "is for a fit, and --evaluations 0 fits nothing")
        errors = held_out_error(
            robot,
            self._logs(robot),
            actuators,
            params=None if self.gains is None else gains_of(robot, self.gains),
            **flags.chosen(self, "compensate timestep sim_steps hold"),
        )
        print(_errors(*errors))

    def _logs(self, robot: Robot) -> list[Log]:
        from batchpid.sim.identification.columns import Reading
        from batchpid.sim.identification.logs import read_logs

        names = "time_unit degrees measured topic command_topic prefix"
        kind: Literal["setpoint", "effort"] | None = "effort" if self.gains is None else "setpoint"
        if self.evaluations == 0 and self.actuators is None:
            kind = None  # _compare_efforts checks the kind of the logs
        return read_logs(robot, self.logs, kind, hold=self.hold, reading=Reading(**flags.chosen(self, names)))

    def _compare_efforts(self, robot: Robot, logs: list[Log], out: Path, details: Path | None) -> None:
        """Print and write the motors that measured efforts show."""
        from batchpid.sim.cli.report import table
        from batchpid.sim.identification.effort_ratios import measured_motors

        if logs[0].measured is None:
            remedy = "give 1 or more, name an actuators file as --actuators, or a log with measured efforts too"
            raise InvalidArgumentError("evaluations", "is 0, and there is no file", value=0, remedy=remedy)
        unused = (*OF_FIT, "gains", "compensate", "sim_steps")
        flags.refuse(self, unused, "is not used where commanded and measured efforts are compared")
        found = measured_motors(robot, logs, timestep=self.timestep, hold=self.hold)
        document = found.document(robot)
        rows = [
            [joint, kind, f"{value:.4g} ± {high - value:.1g}"]
            for joint, kinds in document.items()
            for kind, (value, _, high) in kinds.items()
        ]
        print(table(rows, ["joint", "95 % intervals, SI units", "value"], "llr"))
        print(f"\nerror of the effort on the part that was kept: up to {found.error.max():.2g} of the effort")
        out.parent.mkdir(parents=True, exist_ok=True)
        found.save(out, robot)
        print(f"written: {out}")
        if details is not None:
            write_figures(details, document)
            print(f"written: {details}")


def _errors(before: float, after: float) -> str:
    """Return a line with the errors on the held-out part, of ideal motors and of an actuators file."""
    return f"position error on the part that was kept: {before:.3g} as described, {after:.3g} by the values of the file"


def report(found: Identification) -> str:
    """Return a table of the joints, and the delay, the payload and the errors in lines."""
    from batchpid.sim.cli.report import table
    from batchpid.sim.identification.statistics import LARGEST_MISFIT

    def cell(kind: str, joint: int | None = None, factor: float = 1.0) -> str:
        row = document[kind] if joint is None else document["joints"][names[joint]][kind]
        value, low, high = (factor * each for each in row)
        if (kind, joint) not in found.unknowns.names:
            return f"{value:.4g} taken" if kind == "strength" else "-"
        mark = "" if found.interval(kind, joint) else " ?"
        return f"{value:.4g} ± {max(high - value, value - low):.1g}{mark}"

    document, names = found.document(), [found.robot.joint_names[joint] for joint in found.joints]
    kinds = found.unknowns.per_joint
    taken = found.strength_taken
    rows = [[name, *(cell(kind, joint) for kind in kinds)] for joint, name in enumerate(names)]
    text = [table(rows, ["95 % intervals, SI units", *kinds], "l" + len(kinds) * "r"), ""]
    if "slew" in kinds:
        text.append("slew is the limit of the setpoints' rate: simulate with guard=robot.guard(rate=...)")
    if taken:
        text.append(f"strength taken as 1, because the logs show only ratios to it: {', '.join(taken)}")
    if ("delay", None) in found.unknowns.names:
        text.append(f"delay of the commands: {cell('delay', None, 1e3)} ms")
    else:
        text.append("the efforts were measured, so nothing of the delay shows in them")
    if ("payload", None) in found.unknowns.names:
        payload = cell("payload")
        shows = document["payload"][1] > 0
        text.append(f"payload at the tool: {f'{payload} kg' if shows else 'none that shows'}")
    if found.drive.params is None and found.drive.compensate == "none":
        text.append("gravity: within the logged efforts")
    elif found.drive.compensate != "none":
        way = "through its motors" if found.drive.through else "apart from its motors"
        text.append(f"the robot compensates {found.drive.compensate} {way}")
    text.append(_errors(*found.held_out_error))
    text += found.diagnosis.sentences()
    if found.misfit > LARGEST_MISFIT:
        text.append(
            f"the error there is up to {found.misfit:.2g} times the noise of the sensors, at {found.worst_joint!r}: "
            "the model does not explain all of the motion, and the intervals hold for this motion only"
        )
    elif found.is_short:
        text.append("the logs are one short motion: the intervals hold for this motion only; record others, too")
    return "\n".join(text + _not_identified(found))


def _not_identified(found: Identification) -> list[str]:
    """Return lines for the unknowns that the logs do not identify, by joint, each with the remedy."""
    of_joints, others = found.missing()
    if not of_joints and not others:
        return []
    lines = ["NOT WELL DETERMINED by these logs (marked ?), but part of the optimum, and in the actuators file:"]
    before, after = found.held_out_error
    if not found.uncertainty.identified.any():
        text = (
            "the fit does not explain the motion; check --gains, --timestep, --compensate, or give more --evaluations"
        )
        if after < before and ("payload", None) in found.unknowns.names:
            text = (
                "no value is certain beside a payload; "
                "pass --no-payload if the tool carries none, or record a longer motion without compensation"
            )
        elif after < before:
            text = "no value is certain, though together they lower the error; record a longer and more varied motion"
        return [*lines, f"  everything: {text}"]
    names = [found.robot.joint_names[number] for number in found.joints]
    moves = dict(zip(names, found.uncertainty.moves, strict=True))
    for joint, kinds in of_joints.items():
        if not moves[joint]:
            remedy = "it hardly moves; move it more (batchpid excite)"
        elif {*kinds} == {*found.unknowns.per_joint}:
            remedy = "no value is certain, perhaps their ratios are; record with more load, or faster motion"
        elif "strength" in kinds:
            remedy = "only ratios to the strength are identifiable; record without compensation, or with more load"
        else:
            remedy = "too small compared with its other efforts; move it faster or longer"
        lines.append(f"  {joint}: {', '.join(kinds)}: {remedy}")
    if "delay" in others:
        lines.append("  delay: log every control step, and move faster")
    if "payload" in others:
        lines.append("  payload: no effect in the logs; move the arm against gravity if it carries one")
    return lines
