"""Documents that people read and edit, as YAML or JSON: a head, and one entry per joint, by
name.
"""

from __future__ import annotations

import json
import math
import os
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

import numpy as np

from batchpid.arrays.array_types import Document, DType
from batchpid.arrays.field_tables import Field
from batchpid.checks.validate import choice, file_path
from batchpid.errors import InvalidArgumentError
from batchpid.io.files import write_atomically

T = TypeVar("T")

SUFFIXES = {".yaml": "yaml", ".yml": "yaml", ".json": "json"}


class Schema(NamedTuple):
    """Form of a document: ``format``, ``about``, the keys of ``head``, and ``joints``."""

    format: str
    """Its name and version."""
    content: str
    """Of the document, as in "params"."""
    head: tuple[str, ...]
    """Options for all joints together."""
    fields: Mapping[str, Field]
    """Options of a joint."""
    required: tuple[str, ...] = ()
    """Options that every joint must have."""


def read(path: str | os.PathLike[str]) -> Any:
    """Return the document in a file; raise InvalidArgumentError if it cannot be read."""
    path = file_path("path", path, SUFFIXES)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise InvalidArgumentError(
            str(path), problem, remedy="check its name and your rights"
        ) from None
    return parse(str(path), content, SUFFIXES[path.suffix.lower()])


def write(path: str | os.PathLike[str], dump: Callable[[str], str]) -> None:
    """Write the text of ``dump(format)`` to ``path``; an existing file is replaced as a whole or
    not at all.
    """
    path = file_path("path", path, SUFFIXES)
    write_atomically(path, dump(SUFFIXES[path.suffix.lower()]))


def document(
    schema: Schema, options: Document, joint_names: Sequence[str], about: Mapping[str, Any] | None
) -> Document:
    """Return the document of the ``options`` of a constructor: arrays (1 | envs, joints), or one
    for all joints.
    """
    head = {name: options.pop(name) for name in schema.head if name in options}
    joints = {
        joint: {name: plain(column[:, index]) for name, column in options.items()}
        for index, joint in enumerate(joint_names)
    }
    kept = {"about": json.loads(json.dumps(dict(about)))} if about else {}
    head |= {"dtype": str(head["dtype"])} if "dtype" in head else {}
    return {"format": schema.format, **kept, **head, "joints": joints}


def build(
    source: str,
    document: Any,
    schema: Schema,
    joints: Document,
    make: Callable[..., T],
    **options: Any,
) -> T:
    """Return the result of the constructor ``make`` for a document's ``joints``, in their order,
    and its head.

    Errors name the document and the key. ``options`` are further arguments.
    """
    given = columns(source, joints, schema) | {
        name: document[name] for name in schema.head if name in document
    }
    with named(source):
        return make(len(joints), **given, **options, joint_names=list(joints))


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


def parse_text(text: str) -> Any:
    """Return the document in a text: JSON if it begins with a brace, else YAML."""
    return parse("text", text, "json" if text.lstrip().startswith("{") else "yaml")


def parse(source: str, text: str | bytes, format: str) -> Any:
    """Return the document in a text in ``format``; ``source`` names it in errors."""
    try:
        text = text.decode() if isinstance(text, bytes) else text
        return _parse_json(text) if format == "json" else _parse_yaml(text)
    except Exception as error:  # a damaged text can make the parser raise anything
        said = " ".join(str(error).split())[:300] or type(error).__name__
        raise InvalidArgumentError(
            source, f"cannot be read: {said}", remedy="correct the file"
        ) from None


def render(document: Document, format: str) -> str:
    """Return a document as text in ``format``, "yaml" or "json"."""
    if choice("format", format, ("yaml", "json")) == "json":
        return json.dumps(_without_infinities(document), indent=2, allow_nan=False) + "\n"
    import yaml

    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=10_000)


def check(source: str, document: Any, schema: Schema) -> dict[str, Document]:
    """Return the joints of ``document`` if it is of the form ``schema``."""
    if not isinstance(document, dict) or document.get("format") != schema.format:
        remedy = f"it must contain 'format: {schema.format}'"
        raise InvalidArgumentError(source, f"holds no {schema.content}", remedy=remedy)
    for key in document:
        choice(f"{source}: key", key, ("format", "about", *schema.head, "joints"))
    if not isinstance(document.get("about", {}), dict):
        raise error(source, "about", "must be a mapping", "use 'key: value', or leave it out")
    choice(f"{source}: dtype", document.get("dtype", "float64"), ("float32", "float64"))
    joints = document.get("joints")
    if (
        not isinstance(joints, dict)
        or not joints
        or not all(isinstance(name, str) for name in joints)
    ):
        raise error(source, "joints", "must map names to options", "name the joints")
    for name, options in joints.items():
        if not isinstance(options, dict):
            raise error(
                source,
                "joints",
                "must map options to values",
                "give e.g. an empty mapping, {}",
                name,
            )
        for key in schema.required:
            if key not in options:
                raise error(source, "joints", f"has no {key}", f"give '{key}: <number>'", name)
        for key, value in options.items():
            if key not in schema.fields:
                raise error(
                    source, key, "unknown option", f"use one of {', '.join(schema.fields)}", name
                )
            neutral = schema.fields[key].neutral
            wanted: type = type(neutral)
            for entry in value if isinstance(value, list) and value else [value]:
                if not (is_number(entry) if wanted is float else isinstance(entry, wanted)):
                    problem = f"is {reprlib.repr(entry)}, which is not a {wanted.__name__}"
                    remedy = f"give one, as in '{key}: {neutral}', or a list of one per env"
                    raise error(source, key, problem, remedy, name)
    return joints


def is_number(entry: Any) -> bool:
    """Return whether an entry is a number, an infinity included."""
    whole = isinstance(entry, int) and not isinstance(entry, bool) and abs(entry) < 2**1023
    return whole or isinstance(entry, float) or entry in ("inf", "-inf")


def columns(source: str, joints: dict[str, Document], schema: Schema) -> Document:
    """Return each option that some joint has, as an array (1 or envs, joints)."""
    columns: Document = {}
    for key, field in schema.fields.items():
        if not any(key in options for options in joints.values()):
            continue
        values = {name: options.get(key, field.neutral) for name, options in joints.items()}
        lists = {
            name: value if isinstance(value, list) else [value] for name, value in values.items()
        }
        envs = max(map(len, lists.values()))
        for name, value in lists.items():
            if len(value) not in (1, envs):
                raise error(
                    source, key, f"has {len(value)} values, others {envs}", "give one per env", name
                )
        dtype: DType = {float: float, bool: bool, str: object}[type(field.neutral)]
        columns[key] = np.array(
            [value * (envs // len(value)) for value in lists.values()], dtype=dtype
        ).T
    return columns


def error(
    source: str, key: str, problem: str, remedy: str, joint: str | None = None
) -> InvalidArgumentError:
    """Return the error of a key of a document."""
    return InvalidArgumentError(f"{source}: {key}", problem, joint=joint, remedy=remedy)


def plain(column: Any) -> Any:
    """Return a joint's option as one plain value, or a list of one per env."""
    # The shortest digits that read back as the same number of its dtype: str(float32) has fewer
    # than its float.
    values = [float(str(value)) if isinstance(value, np.floating) else value for value in column]
    values = [bool(value) if isinstance(value, np.bool_) else value for value in values]
    return values[0] if len(values) == 1 else values


def _without_infinities(value: Any) -> Any:
    """Return the document with infinities as the strings "inf" and "-inf": JSON has no number for
    them.
    """
    if isinstance(value, dict):
        return {key: _without_infinities(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_without_infinities(entry) for entry in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def _parse_json(text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> Document:
        if len(dict(pairs)) < len(pairs):
            raise ValueError(f"a key is given twice among {[key for key, _ in pairs]}")
        return dict(pairs)

    return json.loads(text, object_pairs_hook=unique)


def _parse_yaml(text: str) -> Any:
    import yaml  # here, since params in memory need NumPy alone

    class Loader(yaml.SafeLoader):
        """SafeLoader without aliases, which can make a short file explode, and without keys given
        twice.
        """

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
