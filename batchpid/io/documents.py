"""Documents that people read and edit, as YAML: a head, and one entry per joint, by name. The same as
JSON is part of recordings.

A file of params has this form; the keys are the options of :func:`batchpid.make_params`::

    format: batchpid-params-2
    dtype: float64
    anti_windup: conditional
    joints:
      shoulder: {kp: 40.0, ki: 5.0, kd: 2.0, effort_max: 87.0}
      elbow: {kp: 20.0, ki: 5.0, kd: 2.0}
"""

from __future__ import annotations

import json
import os
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from batchpid.arrays.array_types import CHOICES, Document, Rows
from batchpid.arrays.field_tables import Field
from batchpid.arrays.records import Record
from batchpid.checks import choice, file_path, instance, names
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically
from batchpid.law.params import LAW_FIELDS, PIDParams, make_params

R = TypeVar("R", bound="Record")

SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True)
class RecordFile(Generic[R]):
    """Files of one kind of record: a head, and one entry per joint, by name.

    The keys of an entry are the options of the record's constructor; a list gives one value per
    env. Numbers are written with as many digits as it takes to read the same number back. An option
    left out of a joint is off there.
    """

    format: str
    """Name and version of the form, as in "batchpid-params-2"."""
    record: type[R]
    make: Callable[..., R]
    """Constructor of the records."""
    head: tuple[str, ...]
    """Options for all joints together."""
    fields: Mapping[str, Field]
    """Options of a joint."""
    required: tuple[str, ...] = ()
    """Options that every joint must have."""
    partial: bool = False
    """Whether a file may leave joints out, whose options are then off."""

    def dumps(self, record: R, joint_names: Sequence[str]) -> str:
        """Return a record as JSON, whose numbers include NaN and Infinity.

        Raises InvalidArgumentError for a record of another type, or names that do not fit it.
        """
        return json.dumps(self._document(record, joint_names, None))

    def _document(
        self, record: R, joint_names: Sequence[str], about: Mapping[str, object] | None
    ) -> Document:
        """Return the document of a record."""
        instance(self.record.NAME, record, self.record, f"build them with {self.make.__name__}")
        joints = names("joint_names", joint_names, record.num_joints or None)
        options = record.options()
        document: Document = {"format": self.format}
        if about:
            document["about"] = json.loads(json.dumps(dict(about)))
        document |= {name: options.pop(name) for name in self.head if name in options}
        if "dtype" in document:
            document["dtype"] = str(document["dtype"])
        return document | {"joints": self.entries(options, joints)}

    def loads(self, text: str, joint_names: Sequence[str] | None = None) -> tuple[R, list[str]]:
        """Return the record in a text of JSON; otherwise as :meth:`load`."""
        return self._built("text", parsed("text", json.loads, text), joint_names)

    def save(
        self,
        path: str | os.PathLike[str],
        record: R,
        joint_names: Sequence[str],
        about: Mapping[str, object] | None = None,
    ) -> None:
        """Write a record to ``path`` (.yaml or .yml). An existing file is replaced as a whole or not
        at all.

        Parameters
        ----------
        joint_names
            One name per joint.
        about
            Kept with the record, e.g. where it comes from: plain numbers, strings, lists,
            mappings.

        Raises
        ------
        InvalidArgumentError
            A record of another type, names that do not fit it, or an unknown format.
        """
        path = file_path("path", path, SUFFIXES)
        write_atomically(path, render(self._document(record, joint_names, about)))

    def load(
        self, path: str | os.PathLike[str], joint_names: Sequence[str] | None = None
    ) -> tuple[R, list[str]]:
        """Return the record in a file and its joints' names, in the order of ``joint_names`` if
        given.

        Nothing in the file is executed, and every value is checked as in the constructor.

        Raises
        ------
        InvalidArgumentError
            Naming the file, joint and key.
        FileNotFoundError
            The file does not exist.
        """
        return self._built(str(path), read(path), joint_names)

    def entries(self, options: Document, joint_names: Sequence[str]) -> dict[str, Document]:
        """Return the entry of each joint, from options (1 | envs, joints)."""
        return {
            joint: {name: plain(column[:, at]) for name, column in options.items()}
            for at, joint in enumerate(joint_names)
        }

    def arguments(self, source: str, joints: Mapping[str, Document]) -> Document:
        """Return each option that some joint has, as an array (1 | envs, joints)."""
        present = {name for options in joints.values() for name in options}
        return {
            name: _column(source, name, field, joints)
            for name, field in self.fields.items()
            if name in present
        }

    def _built(
        self, source: str, document: Any, joint_names: Sequence[str] | None
    ) -> tuple[R, list[str]]:
        """Return the record of a document and the names of its joints."""
        joints = self._joints(source, document)
        order = list(joints) if joint_names is None else names("joint_names", joint_names)
        missing = sorted(set(order) - set(joints))
        unknown = sorted(set(joints) - set(order))
        if unknown or (missing and not self.partial):
            problem = f"has other joints: missing {missing}, unknown {unknown}"
            remedy = f"the file's joints are {', '.join(joints)}"
            raise InvalidArgumentError(source, problem, remedy=remedy)
        options = self.arguments(source, {joint: joints.get(joint, {}) for joint in order})
        options |= {name: value for name, value in document.items() if name in self.head}
        with named(source):
            return self.make(len(order), **options, joint_names=order), order

    def _joints(self, source: str, document: Any) -> dict[str, Document]:
        """Return the joints of a document of this form, with checked keys."""
        version = document.get("format") if isinstance(document, dict) else None
        if version != self.format:
            problem = f"holds no {self.record.NAME}"
            remedy = f"it must contain 'format: {self.format}'"
            if str(version).rpartition("-")[0] == self.format.rpartition("-")[0]:
                problem = f"is a file of another version ({version}; this one reads {self.format})"
                remedy = "write the file anew"
            raise InvalidArgumentError(source, problem, remedy=remedy)
        # Names and types first: their errors name a key, where a constructor could not.
        for key in document:
            choice(f"{source}: key", key, ("format", "about", *self.head, "joints"))
        if not isinstance(document.get("about", {}), dict):
            raise error(source, "about", "must be a mapping", "use 'key: value', or leave it out")
        choice(f"{source}: dtype", document.get("dtype", "float64"), ("float32", "float64"))
        joints = document.get("joints")
        if not isinstance(joints, dict) or not all(isinstance(name, str) for name in joints or [0]):
            raise error(source, "joints", "must map names to options", "name the joints")
        for joint, options in joints.items():
            if not isinstance(options, dict):
                remedy = "give e.g. an empty mapping, {}"
                raise error(source, "joints", "must map options to values", remedy, joint)
            for name in [name for name in options if name not in self.fields]:
                remedy = f"use one of {', '.join(self.fields)}"
                raise error(source, name, "unknown option", remedy, joint)
            for name in [name for name in self.required if name not in options]:
                remedy = f"give '{name}: <number>'"
                raise error(source, "joints", f"has no {name}", remedy, joint)
        return joints


def _column(
    source: str,
    name: str,
    field: Field,
    joints: Mapping[str, Document],
) -> Rows:
    """Return an option of all joints as an array (1 | envs, joints), neutral where it is left
    out.
    """
    neutral = field.neutral
    kind: type = type(neutral)
    columns: dict[str, list[object]] = {}
    for joint, options in joints.items():
        value = options.get(name, neutral)
        columns[joint] = value if isinstance(value, list) and value else [value]
        for entry in columns[joint]:
            if not (is_number(entry) if kind is float else isinstance(entry, kind)):
                problem = f"is {reprlib.repr(entry)}, which is not a {kind.__name__}"
                remedy = f"give one, as in '{name}: {neutral}', or a list of one per env"
                raise error(source, name, problem, remedy, joint)
    envs = max(map(len, columns.values()))
    for joint, values in columns.items():
        if len(values) not in (1, envs):
            problem = f"has {len(values)} values, others {envs}"
            raise error(source, name, problem, "give one per env", joint)
    rows = [values * (envs // len(values)) for values in columns.values()]
    return np.array(rows, dtype=kind).T


def read(path: str | os.PathLike[str]) -> Any:
    """Return the document in a file. Raises InvalidArgumentError for a file that holds none."""
    path = file_path("path", path, SUFFIXES)
    return parsed(str(path), _parse_yaml, path.read_bytes())


@contextmanager
def named(source: str) -> Iterator[None]:
    """Begin the messages of InvalidArgumentErrors from the block with ``source``, a file or a place
    in it.
    """
    try:
        yield
    except InvalidArgumentError as error:
        facts = {
            name: getattr(error, name) for name in ("joint", "entry", "env", "value", "remedy")
        }
        raise InvalidArgumentError(f"{source}: {error.argument}", error.problem, **facts) from None


def parsed(source: str, parse: Callable[[Any], Any], text: str | bytes) -> Any:
    """Return the document that ``parse`` makes of a text; ``source`` names it in errors."""
    try:
        return parse(text)
    except Exception as error:  # a damaged text can make the parser raise anything
        cause = " ".join(str(error).split())[:300] or type(error).__name__
        problem = f"cannot be read: {cause}"
        raise InvalidArgumentError(source, problem, remedy="correct the file") from None


def render(document: Document) -> str:
    """Return a document as YAML."""
    import yaml

    return yaml.safe_dump(
        document,
        sort_keys=False,
        default_flow_style=None,
        width=10_000,
    )


def is_number(entry: object) -> bool:
    """Return whether an entry is a number, an infinity included."""
    whole = isinstance(entry, int) and not isinstance(entry, bool) and abs(entry) < 2**1023
    return whole or isinstance(entry, float)


def error(
    source: str,
    key: str,
    problem: str,
    remedy: str,
    joint: str | None = None,
) -> InvalidArgumentError:
    """Return the error of a key of a document."""
    return InvalidArgumentError(f"{source}: {key}", problem, joint=joint, remedy=remedy)


def plain(column: Rows) -> Any:
    """Return a joint's option as one plain value, or a list of one per env."""
    values = column.tolist()
    if column.dtype == np.float32:
        # The shortest digits that read back as the same number of its dtype: its float has more.
        values = [float(str(value)) for value in column]
    if len(values) == 1:
        return values[0]
    return values


def _parse_yaml(text: bytes) -> Any:
    import yaml  # here, since params in memory need NumPy alone

    class Loader(yaml.SafeLoader):
        """SafeLoader without aliases, which can make a short file explode, and without keys given
        twice.
        """

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.AliasEvent):
                raise ValueError("aliases are not allowed")
            return super().compose_node(parent, index)

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            mapping = super().construct_mapping(node, deep=True)
            if len(mapping) < len(node.value):
                raise ValueError(f"a key is given twice{node.start_mark}")
            return mapping

    return yaml.load(text.decode(), Loader=Loader)  # a SafeLoader: plain data only


PARAMS = RecordFile(
    "batchpid-params-2",
    PIDParams,
    make_params,
    ("dtype", *CHOICES),
    LAW_FIELDS,
    required=("kp",),
)
dumps_params = PARAMS.dumps
loads_params = PARAMS.loads
save_params = PARAMS.save
load_params = PARAMS.load
