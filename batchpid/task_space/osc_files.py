"""Options of operational-space control to and from YAML or JSON that people read and edit.

A file has this form::

    format: batchpid-osc-1
    stiffness: [400.0, 400.0, 400.0, 900.0, 900.0, 900.0]
    damping_ratio: 1.0
    posture_stiffness: 20.0

The keys are the options of :func:`batchpid.task_space.make_osc_params`: numbers, lists of one entry per axis or joint,
and choices by name.
"""

from __future__ import annotations

import json
import os
import reprlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from batchpid.arrays.array_types import Document
from batchpid.checks.validate import choice
from batchpid.io import documents
from batchpid.task_space.osc_params import FIELDS, TASK_CHOICES

FORMAT = "batchpid-osc-1"
_KEYS = (*FIELDS, *TASK_CHOICES)


def save_osc_options(
    path: str | os.PathLike[str], options: Mapping[str, Any], about: Mapping[str, Any] | None = None
) -> None:
    """Write ``options`` of :func:`batchpid.task_space.make_osc_params` to ``path`` (.yaml, .yml or .json).

    ``about`` is kept with them: plain numbers, strings, lists and mappings. An existing file is replaced as a whole or
    not at all.

    Raises
    ------
    InvalidArgumentError
        An option is unknown, or the file has another suffix.
    """
    plain = {choice("options", name, _KEYS): np.asarray(value).tolist() for name, value in options.items()}
    kept = {"about": json.loads(json.dumps(dict(about)))} if about else {}
    documents.write(path, lambda format: documents.render({"format": FORMAT, **kept, **plain}, format))


def load_osc_options(path: str | os.PathLike[str]) -> Document:
    """Return the options in a file, for :func:`batchpid.task_space.make_osc_params`, which checks their values.

    Raises
    ------
    InvalidArgumentError
        Naming the file and the key.
    FileNotFoundError
        The file does not exist.
    """
    source, document = str(path), documents.read(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        remedy = f"it must contain 'format: {FORMAT}'; batchpid tune --control osc writes such files"
        raise documents.error(source, "format", "is not that of gains for operational-space control", remedy)
    options = {name: value for name, value in document.items() if name not in ("format", "about")}
    for name, value in options.items():
        choice(f"{source}: key", name, _KEYS)
        if name in TASK_CHOICES:
            choice(f"{source}: {name}", value, TASK_CHOICES[name])
            continue
        listed, is_mask = isinstance(value, list), isinstance(FIELDS[name].neutral, bool)
        for entry in value if listed else [value]:
            if not (isinstance(entry, bool) if is_mask else documents.is_number(entry)):
                remedy = "give true or false for each axis" if is_mask else "give a number, or one per axis or joint"
                raise documents.error(source, name, f"is {reprlib.repr(value)}", remedy)
        if not is_mask:
            options[name] = [float(entry) for entry in value] if listed else float(value)
    return options
