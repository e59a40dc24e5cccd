"""Lists of logs, each with its settings: a YAML file given in place of a log.

``logs`` is the list. Other keys at the top are defaults for all logs::

    gains: soft.yaml            # gains of the PID law, as for --gains; without gains the efforts are used
    logs:
    - log: monday.csv
      held_out: true            # tests the result; then the other logs are fitted as a whole
    - log: tuesday.csv
      gains: stiff.yaml
      payload: 0.5              # known mass at the tool [kg]
      urdf: arm_with_gripper.urdf
      sign: {elbow: -1}         # factor of every column of a joint
      scale: {elbow: 0.105}     # factor of its efforts, such as N m per A
      start: 2.0                # times of the first and last row [s], as in the log
      end: 30.0

Further keys are ``hold`` and the fields of :class:`batchpid.sim.identification.columns.Reading`. Names of files are
relative to the folder of the list.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import batchpid as bp
from batchpid.arrays.array_types import Document
from batchpid.checks.validate import choice, flag, instance, number
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.sim.identification.columns import Reading, TimeUnit, error
from batchpid.sim.identification.log import CommandKind, Log, LogSettings, Sensor
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tuning.gain_sets import NAMES, gain_set

SUFFIXES = (".yaml", ".yml")
OWN = ("log", "gains", "payload", "urdf", "held_out", "hold")
MOST_PAYLOAD = 1000.0


def read_log_list(
    path: Path,
    robot: Robot,
    read: Callable[..., list[Log]],
    kind: CommandKind | None,
    hold: bool,
    reading: Reading,
) -> list[Log]:
    """Return the logs of a list, with their settings; ``read`` is :func:`batchpid.sim.identification.logs.read_logs`.

    ``kind``, ``hold`` and ``reading`` are defaults, which keys of the list replace. Raises InvalidArgumentError for an
    unknown key or an invalid value, and the errors of :func:`batchpid.sim.identification.logs.read_logs`.
    """
    document = documents.read(path)
    if not isinstance(document, dict) or not isinstance(document.get("logs"), list) or not document["logs"]:
        raise error(str(path), "is not a list of logs", "write 'logs:' and a list of mappings, each with the key 'log'")
    common = {"hold": hold, **reading._asdict(), **{key: each for key, each in document.items() if key != "logs"}}
    found: list[Log] = []
    for number_, entry in enumerate(document["logs"]):
        where = f"{path}: logs[{number_}]"
        entry = common | instance(where, entry, dict, "write a mapping, such as {log: monday.csv}")
        for key in entry:
            choice(f"{where}: key", key, (*OWN, *Reading._fields))
        if not isinstance(entry.get("log"), str) or Path(entry["log"]).suffix.lower() in SUFFIXES:
            raise error(where, "names no log", "add 'log: FILE', of another kind than this list")
        with documents.named(where):
            found += _read(path.parent, robot, read, kind, entry)
    if any(log.settings.held_out for log in found):
        whole = [log.settings._replace(held_out=bool(log.settings.held_out)) for log in found]
        found = [replace(log, settings=each) for log, each in zip(found, whole, strict=True)]
    return found


def gains_of(robot: Robot, name: str) -> bp.PIDParams:
    """Return the gains of a name or file, for all joints of ``robot``; a params file may have only some joints."""
    path, known = Path(name), [each for each in NAMES if each != "drive"]
    if name not in known and not os.path.isfile(path):  # False, too, for text that cannot be a path
        remedy = f"use a file or {', '.join(known)}"
        raise InvalidArgumentError("gains", "is neither a name nor a file of gains", value=name, remedy=remedy)
    if name in known or path.suffix.lower() == ".xml":
        return gain_set(robot, name).params
    names = bp.load_params(path)[1]
    order = [joint for joint in robot.joint_names if joint in names]
    if len(order) < len(names):
        return bp.load_params(path, robot.joint_names)[0]  # raises, naming the joints
    return bp.load_params(path, order)[0]


def _read(
    folder: Path,
    robot: Robot,
    read: Callable[..., list[Log]],
    kind: CommandKind | None,
    entry: Document,
) -> list[Log]:
    """Return the parts of one log of a list, divided where its times jump, with its settings."""
    own, params = robot, None
    if (urdf := entry.get("urdf")) is not None:
        own = Robot.load(folder / instance("urdf", urdf, str, "name a file"))
        if own.joint_names != robot.joint_names:
            remedy = f"use one with {', '.join(robot.joint_names)}"
            raise error("urdf", f"has the joints {', '.join(own.joint_names)}", remedy)
    if (gains := entry.get("gains")) is not None:
        gains = instance("gains", gains, str, "name a file, or gains of the robot")
        params = gains_of(own, str(folder / gains) if os.path.isfile(folder / gains) else gains)
    payload = number("payload", entry.get("payload", 0.0), 0.0, MOST_PAYLOAD, "kg")
    held_out = entry.get("held_out")
    if held_out is not None:
        flag("held_out", held_out)
    settings = LogSettings(None if own is robot else own, params, payload, held_out)
    wanted: CommandKind | None = kind if params is None else "setpoint"
    hold, reading = flag("hold", entry["hold"]), _reading(robot, entry)
    found = read(own, [folder / entry["log"]], wanted, hold=hold, reading=reading)
    return [replace(log, settings=settings) for log in found]


def _reading(robot: Robot, entry: Document) -> Reading:
    """Return the options of an entry that are fields of :class:`Reading`."""
    reading = Reading(**{key: entry[key] for key in Reading._fields})
    if reading.time_unit is not None:
        choice("time_unit", reading.time_unit, get_args(TimeUnit))
    if reading.measured is not None:
        choice("measured", reading.measured, get_args(Sensor))
    flag("degrees", reading.degrees)
    for key in ("topic", "prefix", *(["command_topic"] if reading.command_topic is not None else [])):
        instance(key, getattr(reading, key), str, "write a text")
    for key in ("sign", "scale"):
        factors = instance(key, getattr(reading, key) or {}, dict, "write {JOINT: NUMBER}")
        for joint, factor in factors.items():
            choice(key, joint, robot.joint_names)
            size = abs(number(f"{key}: {joint}", factor, -math.inf, math.inf, "1"))
            if size == 0 or (key == "sign" and size != 1):
                wanted = "1 or -1" if key == "sign" else "another number than 0"
                raise error(f"{key}: {joint}", "is no such factor", f"write {wanted}", factor)
    for key in ("start", "end"):
        if not documents.is_number(getattr(reading, key)):
            raise error(key, "is not a number", "write a time in seconds", getattr(reading, key))
    return reading
