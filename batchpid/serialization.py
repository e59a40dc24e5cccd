"""Params to and from YAML or JSON files that people read and edit: one entry per joint, by name.

A file says::

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
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from batchpid.choices import CHOICES
from batchpid.errors import InvalidArgumentError
from batchpid.params import PIDParams, make_params

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
"""The options of a joint, and the value that is off."""
HEAD = ("format", "about", "dtype", *CHOICES, "joints")


def save_params(
    path: str | os.PathLike[str],
    params: PIDParams,
    joint_names: Sequence[str],
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write ``params`` to ``path`` (.yaml, .yml or .json); an existing file is replaced as a whole or not at all.

    ``about`` is kept beside them for :func:`load_about`: plain numbers, strings, lists and mappings, e.g. where the
    params come from.

    Raises
    ------
    InvalidArgumentError
        If the names do not fit the params, or the suffix is another.
    """
    path, names = Path(path), [str(name) for name in joint_names]
    if len(names) != params.num_joints or len(set(names)) != len(names):
        raise InvalidArgumentError(
            "joint_names",
            f"are not {params.num_joints} different names",
            value=names,
            remedy="name every joint of the params once",
        )
    options = params.options()
    document: dict[str, Any] = {"format": FORMAT}
    if about:
        document["about"] = json.loads(json.dumps(dict(about)))
    document["dtype"] = str(options.pop("dtype"))
    document |= {name: options.pop(name) for name in CHOICES}
    document["joints"] = {
        name: {key: _plain(column[:, joint]) for key, column in options.items()} for joint, name in enumerate(names)
    }
    if _is_yaml(path):
        text = yaml.dump(document, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=10_000)
    else:
        text = json.dumps(_without_infinities(document), indent=2, allow_nan=False) + "\n"
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_text(text, encoding="utf-8")
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def load_params(path: str | os.PathLike[str], joint_names: Sequence[str] | None = None) -> tuple[PIDParams, list[str]]:
    """Return the params in a file and their joints' names, in the order of ``joint_names`` where given.

    Nothing in the file is executed, and every value passes :func:`batchpid.make_params`: a file from a stranger is
    at worst refused.

    Raises
    ------
    InvalidArgumentError
        Naming the file, joint and key.
    FileNotFoundError
        If there is no such file.
    """
    if not isinstance(path, str | os.PathLike) or "\0" in os.fspath(path):
        raise InvalidArgumentError("path", "is no path", value=path, remedy="give the file's name")
    path = Path(path)
    document = _parsed(path)
    joints = _checked(path, document)
    names = list(joints)
    if joint_names is not None:
        if isinstance(joint_names, str) or not isinstance(joint_names, Sequence):
            raise InvalidArgumentError(
                "joint_names",
                "is no list of names",
                value=joint_names,
                remedy="name the joints in the order wanted",
            )
        names = [str(name) for name in joint_names]
        if sorted(names) != sorted(joints):
            missing, unknown = sorted(set(names) - set(joints)), sorted(set(joints) - set(names))
            raise InvalidArgumentError(
                str(path),
                f"does not hold these joints: missing {missing}, unknown {unknown}",
                remedy=f"the file's joints are {', '.join(joints)}",
            )
    head = {name: document[name] for name in ("dtype", *CHOICES) if name in document}
    options = _columns(path, {name: joints[name] for name in names})
    try:
        return make_params(len(names), **options, **head, joint_names=names), names
    except InvalidArgumentError as error:
        raise InvalidArgumentError(
            f"{path}: {error.argument}",
            error.problem,
            remedy=error.remedy,
            joint=error.joint,
            env=error.env,
            value=error.value,
        ) from None


def load_about(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what :func:`save_params` kept beside the params in a file; empty if nothing.

    Raises
    ------
    InvalidArgumentError
        As :func:`load_params`.
    """
    path = Path(path)
    document = _parsed(path)
    _checked(path, document)
    return dict(document.get("about", {}))


def _parsed(path: Path) -> Any:
    parse = _parse_yaml if _is_yaml(path) else _parse_json
    try:
        return parse(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        said = " ".join(str(error).split())[:300] or type(error).__name__
        raise InvalidArgumentError(str(path), f"cannot be read: {said}", remedy="correct the file") from None


def _plain(column: Any) -> Any:
    """Return a joint's option as one plain value, or a list of one per env."""
    values = [_plain_scalar(value) for value in column]
    return values[0] if len(values) == 1 else values


def _plain_scalar(value: Any) -> Any:
    if isinstance(value, np.floating):
        return float(str(value))  # the shortest digits that read back as the same number of this dtype
    return bool(value) if isinstance(value, np.bool_) else value


def _without_infinities(value: Any) -> Any:
    """Return the document with infinities as the strings "inf" and "-inf": JSON has no number for them."""
    if isinstance(value, dict):
        return {key: _without_infinities(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_without_infinities(entry) for entry in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def _is_yaml(path: Path) -> bool:
    if path.suffix not in (".yaml", ".yml", ".json"):
        raise InvalidArgumentError(
            "path", "ends in no known format", value=str(path), remedy="use .yaml, .yml or .json"
        )
    return path.suffix != ".json"


def _checked(path: Path, document: Any) -> dict[str, dict[str, Any]]:
    """Return the joints of a document of the right form."""
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InvalidArgumentError(str(path), "holds no params", remedy=f"it must say 'format: {FORMAT}'")
    for key in document:
        if key not in HEAD:
            raise InvalidArgumentError(f"{path}: {key}", "is no known key", remedy=f"choose from {', '.join(HEAD)}")
    if not isinstance(document.get("about", {}), dict):
        raise InvalidArgumentError(f"{path}: about", "is no mapping", remedy="name what is told, or leave it out")
    if document.get("dtype", "float64") not in ("float32", "float64"):
        raise InvalidArgumentError(f"{path}: dtype", "is unknown", remedy="choose from float32, float64")
    joints = document.get("joints")
    if not isinstance(joints, dict) or not joints or not all(isinstance(name, str) for name in joints):
        raise InvalidArgumentError(f"{path}: joints", "is no mapping from names to options", remedy="name the joints")
    for name, options in joints.items():
        if not isinstance(options, dict) or "kp" not in options:
            raise InvalidArgumentError(f"{path}: joints", "has no kp", joint=name, remedy="give 'kp: <number>'")
        for key, value in options.items():
            if key not in OFF:
                raise InvalidArgumentError(
                    f"{path}: {key}", "is no known option", joint=name, remedy=f"choose from {', '.join(OFF)}"
                )
            for entry in value if isinstance(value, list) and value else [value]:
                _check_entry(path, name, key, entry)
    return joints


def _check_entry(path: Path, joint: str, key: str, entry: Any) -> None:
    wanted: type = type(OFF[key])
    if wanted is float:
        whole = isinstance(entry, int) and not isinstance(entry, bool) and abs(entry) < 2**1023
        good = whole or isinstance(entry, float) or entry in ("inf", "-inf")
    else:
        good = isinstance(entry, wanted)
    if not good:
        raise InvalidArgumentError(
            f"{path}: {key}",
            f"is {reprlib.repr(entry)}, which is no {wanted.__name__}",
            joint=joint,
            remedy=f"give one, as in '{key}: {OFF[key]}', or a list of one per env",
        )


def _columns(path: Path, joints: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return each option that some joint has, as an array (1 or envs, joints)."""
    columns: dict[str, Any] = {}
    for key, off in OFF.items():
        if not any(key in options for options in joints.values()):
            continue
        values = {name: options.get(key, off) for name, options in joints.items()}
        rows = max(len(value) if isinstance(value, list) else 1 for value in values.values())
        for name, value in values.items():
            if isinstance(value, list) and len(value) not in (1, rows):
                raise InvalidArgumentError(
                    f"{path}: {key}",
                    f"has {len(value)} values, others {rows}",
                    joint=name,
                    remedy="give one per env",
                )
        spread = [
            value * (rows // len(value)) if isinstance(value, list) else [value] * rows for value in values.values()
        ]
        dtype: Any = {float: float, bool: bool, str: object}[type(off)]
        columns[key] = np.array(spread, dtype=dtype).T
        if key == "tracking_time":
            for name, options in joints.items():
                if "back_calculation" in str(options.get("anti_windup")) and key not in options:
                    raise InvalidArgumentError(
                        f"{path}: {key}",
                        "is missing, while other joints have it",
                        joint=name,
                        remedy="give it too",
                    )
    return columns


class _Loader(yaml.SafeLoader):
    """SafeLoader without aliases, which can make a short file explode, and without keys given twice."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f"aliases are not allowed, {self.peek_event().start_mark}")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        mapping = super().construct_mapping(node, deep=True)
        if len(mapping) < len(node.value):
            raise yaml.YAMLError(f"a key is given twice{node.start_mark}")
        return mapping


class _Dumper(yaml.SafeDumper):
    """SafeDumper without aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _parse_yaml(text: str) -> Any:
    return yaml.load(text, Loader=_Loader)  # a SafeLoader: plain data only


def _parse_json(text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            raise ValueError(f"a key is given twice among {[key for key, _ in pairs]}")
        return dict(pairs)

    return json.loads(text, object_pairs_hook=unique)
