"""Params to and from YAML or JSON that people read and edit: one entry per joint, by name.

A file has this form::

    format: batchpid-params-1
    dtype: float64
    integration: output_first
    joints:
      shoulder: {kp: 40.0, ki: 5.0, kd: 2.0, effort_max: 87.0, anti_windup: conditional}
      elbow: {kp: 20.0, ki: 5.0, kd: 2.0}

The keys are the options of :func:`batchpid.make_params`; a list gives one value per env. Numbers are written with as
many digits as it takes to read the same number back. An option left out of a joint is off there.
"""

from __future__ import annotations

import json
import math
import os
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from batchpid.choices import CHOICES
from batchpid.errors import InvalidArgumentError
from batchpid.files import write_atomically
from batchpid.params import PIDParams, make_params
from batchpid.validate import choice, file_path, names

FORMAT = "batchpid-params-1"
OFF = {
    "kp": 0.0,
    "ki": 0.0,
    "kd": 0.0,
    "effort_min": -math.inf,
    "effort_max": math.inf,
    "effort_rate_limit": math.inf,
    "integral_min": -math.inf,
    "integral_max": math.inf,
    "derivative_filter_time": 0.0,
    "setpoint_weight": 1.0,
    "setpoint_weight_derivative": 0.0,
    "deadband": 0.0,
    "tracking_time": math.inf,
    "anti_windup": "none",
    "continuous": False,
}
"""Options of a joint, with the value that is off."""
HEAD = ("format", "about", "dtype", *CHOICES, "joints")
"""Keys of a document."""
SUFFIXES = {".yaml": "yaml", ".yml": "yaml", ".json": "json"}


def dumps_params(
    params: PIDParams, joint_names: Sequence[str], about: Mapping[str, Any] | None = None, format: str = "yaml"
) -> str:
    """Return ``params`` as text.

    Parameters
    ----------
    joint_names
        One name per joint.
    about
        Kept with the params for :func:`load_about`, e.g. where they come from: plain numbers, strings, lists, mappings.
    format
        "yaml" or "json".

    Raises
    ------
    InvalidArgumentError
        Names that do not fit the params, or an unknown format.
    """
    joints = names("joint_names", joint_names, params.num_joints)
    options = params.options()
    document: dict[str, Any] = {"format": FORMAT}
    if about:
        document["about"] = json.loads(json.dumps(dict(about)))
    document["dtype"] = str(options.pop("dtype"))
    document |= {name: options.pop(name) for name in CHOICES}
    document["joints"] = {
        joint: {name: _plain(column[:, index]) for name, column in options.items()}
        for index, joint in enumerate(joints)
    }
    if choice("format", format, ("yaml", "json")) == "json":
        return json.dumps(_without_infinities(document), indent=2, allow_nan=False) + "\n"
    import yaml

    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10_000)


def loads_params(text: str, joint_names: Sequence[str] | None = None) -> tuple[PIDParams, list[str]]:
    """Return the params in a text, JSON if it begins with a brace and else YAML; otherwise as :func:`load_params`."""
    format = "json" if text.lstrip().startswith("{") else "yaml"
    return _build("text", _parse("text", text, format), joint_names)


def save_params(
    path: str | os.PathLike[str], params: PIDParams, joint_names: Sequence[str], about: Mapping[str, Any] | None = None
) -> None:
    """Write ``params`` to ``path`` (.yaml, .yml or .json), as :func:`dumps_params`.

    An existing file is replaced as a whole or not at all.
    """
    path = file_path("path", path, SUFFIXES)
    write_atomically(path, dumps_params(params, joint_names, about, SUFFIXES[path.suffix.lower()]))


def load_params(path: str | os.PathLike[str], joint_names: Sequence[str] | None = None) -> tuple[PIDParams, list[str]]:
    """Return the params in a file and their joints' names, in the order of ``joint_names`` if given.

    Nothing in the file is executed, and every value is checked as in :func:`batchpid.make_params`.

    Raises
    ------
    InvalidArgumentError
        Naming the file, joint and key.
    FileNotFoundError
        The file does not exist.
    """
    return _build(str(path), _read(path), joint_names)


def load_about(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the ``about`` that :func:`save_params` wrote; empty if there is none. Raises as :func:`load_params`."""
    document = _read(path)
    _check(str(path), document)
    return dict(document.get("about", {}))


def _read(path: str | os.PathLike[str]) -> Any:
    path = file_path("path", path, SUFFIXES)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise InvalidArgumentError(str(path), problem, remedy="check its name and your rights") from None
    return _parse(str(path), content, SUFFIXES[path.suffix.lower()])


def _parse(source: str, text: str | bytes, format: str) -> Any:
    try:
        text = text.decode() if isinstance(text, bytes) else text
        return _parse_json(text) if format == "json" else _parse_yaml(text)
    except Exception as error:  # a damaged text can make the parser raise anything
        said = " ".join(str(error).split())[:300] or type(error).__name__
        raise InvalidArgumentError(source, f"cannot be read: {said}", remedy="correct the file") from None


def _build(source: str, document: Any, joint_names: Sequence[str] | None) -> tuple[PIDParams, list[str]]:
    """Return the params of a document and the names of their joints."""
    joints = _check(source, document)
    order = list(joints) if joint_names is None else names("joint_names", joint_names)
    missing, unknown = sorted(set(order) - set(joints)), sorted(set(joints) - set(order))
    if missing or unknown:
        problem = f"does not hold these joints: missing {missing}, unknown {unknown}"
        raise InvalidArgumentError(source, problem, remedy=f"the file's joints are {', '.join(joints)}")
    head = {name: document[name] for name in ("dtype", *CHOICES) if name in document}
    options = _columns(source, {joint: joints[joint] for joint in order})
    try:
        return make_params(len(order), **options, **head, joint_names=order), order
    except InvalidArgumentError as error:
        where = {"joint": error.joint, "env": error.env, "value": error.value, "remedy": error.remedy}
        raise InvalidArgumentError(f"{source}: {error.argument}", error.problem, **where) from None


def _check(source: str, document: Any) -> dict[str, dict[str, Any]]:
    """Return the joints of a document of the right form."""
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InvalidArgumentError(source, "holds no params", remedy=f"it must contain 'format: {FORMAT}'")
    for key in document:
        choice(f"{source}: key", key, HEAD)
    if not isinstance(document.get("about", {}), dict):
        raise _error(source, "about", "must be a mapping", "use 'key: value', or leave it out")
    choice(f"{source}: dtype", document.get("dtype", "float64"), ("float32", "float64"))
    joints = document.get("joints")
    if not isinstance(joints, dict) or not joints or not all(isinstance(name, str) for name in joints):
        raise _error(source, "joints", "must map names to options", "name the joints")
    for name, options in joints.items():
        if not isinstance(options, dict) or "kp" not in options:
            raise _error(source, "joints", "has no kp", "give 'kp: <number>'", name)
        for key, value in options.items():
            if key not in OFF:
                raise _error(source, key, "unknown option", f"use one of {', '.join(OFF)}", name)
            wanted: type = type(OFF[key])
            for entry in value if isinstance(value, list) and value else [value]:
                if not (_is_number(entry) if wanted is float else isinstance(entry, wanted)):
                    problem = f"is {reprlib.repr(entry)}, which is no {wanted.__name__}"
                    remedy = f"give one, as in '{key}: {OFF[key]}', or a list of one per env"
                    raise _error(source, key, problem, remedy, name)
    return joints


def _is_number(entry: Any) -> bool:
    whole = isinstance(entry, int) and not isinstance(entry, bool) and abs(entry) < 2**1023
    return whole or isinstance(entry, float) or entry in ("inf", "-inf")


def _columns(source: str, joints: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return each option that some joint has, as an array (1 or envs, joints)."""
    columns: dict[str, Any] = {}
    for key, off in OFF.items():
        if not any(key in options for options in joints.values()):
            continue
        values = {name: options.get(key, off) for name, options in joints.items()}
        lists = {name: value if isinstance(value, list) else [value] for name, value in values.items()}
        envs = max(map(len, lists.values()))
        for name, value in lists.items():
            if len(value) not in (1, envs):
                raise _error(source, key, f"has {len(value)} values, others {envs}", "give one per env", name)
            back = "back_calculation" in str(joints[name].get("anti_windup"))
            if key == "tracking_time" and back and key not in joints[name]:
                raise _error(source, key, "is missing, while other joints have it", "give it too", name)
        dtype: Any = {float: float, bool: bool, str: object}[type(off)]
        columns[key] = np.array([value * (envs // len(value)) for value in lists.values()], dtype=dtype).T
    return columns


def _error(source: str, key: str, problem: str, remedy: str, joint: str | None = None) -> InvalidArgumentError:
    return InvalidArgumentError(f"{source}: {key}", problem, joint=joint, remedy=remedy)


def _plain(column: Any) -> Any:
    """Return a joint's option as one plain value, or a list of one per env."""
    # The shortest digits that read back as the same number of its dtype: str(float32) has fewer than its float.
    values = [float(str(value)) if isinstance(value, np.floating) else value for value in column]
    values = [bool(value) if isinstance(value, np.bool_) else value for value in values]
    return values[0] if len(values) == 1 else values


def _without_infinities(value: Any) -> Any:
    """Return the document with infinities as the strings "inf" and "-inf": JSON has no number for them."""
    if isinstance(value, dict):
        return {key: _without_infinities(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_without_infinities(entry) for entry in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def _parse_json(text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            raise ValueError(f"a key is given twice among {[key for key, _ in pairs]}")
        return dict(pairs)

    return json.loads(text, object_pairs_hook=unique)


def _parse_yaml(text: str) -> Any:
    import yaml  # here, since params in memory need NumPy alone

    class Loader(yaml.SafeLoader):
        """SafeLoader without aliases, which can make a short file explode, and without keys given twice."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise ValueError(f"aliases are not allowed, {self.peek_event().start_mark}")
            return super().compose_node(parent, index)

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            mapping = super().construct_mapping(node, deep=True)
            if len(mapping) < len(node.value):
                raise ValueError(f"a key is given twice{node.start_mark}")
            return mapping

    return yaml.load(text, Loader=Loader)  # a SafeLoader: plain data only
