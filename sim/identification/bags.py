"""Logs in ROS bags: ``sensor_msgs/JointState`` in bags of ROS 1, in bags of ROS 2, and in MCAP files.

Messages hold positions, velocities and efforts of joints by name, in any order. In the topic of measurements, efforts
are measured efforts. Positions in the topic of commands are setpoints, and its efforts are commanded efforts.
"""

from __future__ import annotations

from collections import defaultdict
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Float64
from batchpid.errors import BatchPIDError, MissingDependencyError
from batchpid.sim.identification.columns import Reading, error

JOINT_STATE = "sensor_msgs/msg/JointState"
SUFFIXES = (".bag", ".mcap", ".db3")
_STATES = {"position": "qpos", "velocity": "qvel", "effort": "measured_effort"}
_COMMANDS = {"position": "setpoint", "effort": "effort"}


def is_bag(path: Path) -> bool:
    """Return whether ``path`` is a bag: a file of ROS 1, a file of MCAP or SQLite, or the folder of a ROS 2 bag."""
    return path.suffix.lower() in SUFFIXES or (path / "metadata.yaml").exists()


def read_bag(path: Path, reading: Reading) -> list[dict[str, Float64]]:
    """Return the columns of a bag by name: of its measurements, and of its commands if ``reading`` names their topic.

    Times are in seconds since the first measurement. They come from the stamps of the headers, or from the bag if a
    stamp is 0. If messages have different joints, the most frequent set of joints is used.

    Raises
    ------
    InvalidArgumentError
        The bag cannot be read, or lacks a topic.
    MissingDependencyError
        rosbags is not installed.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingDependencyError("rosbags", "a log in a ROS bag", "logs") from None
    topics = {reading.topic: _STATES} | ({reading.command_topic: _COMMANDS} if reading.command_topic else {})
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
            known = sorted(each.topic for each in reader.connections if each.msgtype == JOINT_STATE)
            for topic in topics:
                if topic not in known:
                    remedy = f"use one of its topics of {JOINT_STATE}: {', '.join(known) or 'there are none'}"
                    raise error(str(path), f"has no topic {topic!r} of {JOINT_STATE}", remedy)
            messages: dict[str, list[Any]] = {topic: [] for topic in topics}
            chosen = [each for each in reader.connections if each.topic in topics]
            for connection, received, raw in reader.messages(connections=chosen):
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp
                messages[connection.topic].append((stamp.sec * 10**9 + stamp.nanosec or received, message))
    except BatchPIDError:
        raise
    except Exception as bad:  # a damaged file can make the library raise anything
        raise error(str(path), f"cannot be read: {bad}", "correct or record it again") from None
    begin = min((stamp for stamp, _ in messages[reading.topic]), default=0)
    return [_columns(f"{path}: {topic}", messages[topic], names, begin) for topic, names in topics.items()]


def _columns(source: str, messages: list[Any], names: dict[str, str], begin: int) -> dict[str, Float64]:
    """Return the columns of messages with their stamps [ns]; ``names`` are the quantities by the messages' fields."""
    groups = defaultdict[tuple[str, ...], list[Any]](list)
    for stamp, message in messages:
        groups[tuple(message.name)].append((stamp, message))
    if not groups:
        raise error(source, "has no messages", "choose another topic")
    joints, rows = max(groups.items(), key=lambda group: len(group[1]))
    rows.sort(key=itemgetter(0))  # a bag has them in the order of arrival
    columns = {"time": np.array([stamp - begin for stamp, _ in rows]) / 1e9}
    for field, quantity in names.items():
        values = [getattr(message, field) for _, message in rows]
        if all(len(value) == len(joints) for value in values):  # a driver without such a value leaves the list empty
            columns |= {f"{quantity}:{joint}": column for joint, column in zip(joints, np.array(values).T, strict=True)}
    return columns
