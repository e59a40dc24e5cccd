"""Params to and from YAML or JSON that people read and edit: one entry per joint, by name.

A file has this form::

    format: batchpid-params-1
    dtype: float64
    integration: output_first
    joints:
      shoulder: {kp: 40.0, ki: 5.0, kd: 2.0, effort_max: 87.0, anti_windup: conditional}
      elbow: {kp: 20.0, ki: 5.0, kd: 2.0}

The keys are the options of :func:`batchpid.make_params`; a list gives one value per env. Numbers
are written with as many digits as it takes to read the same number back. An option left out of a
joint is off there.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from batchpid.arrays.array_types import Document
from batchpid.arrays.choices import CHOICES
from batchpid.checks.validate import instance, names
from batchpid.errors import InvalidArgumentError
from batchpid.io import documents
from batchpid.law.params import FIELDS, PIDParams, make_params

SCHEMA = documents.Schema(
    "batchpid-params-1", "params", ("dtype", *CHOICES), FIELDS, required=("kp",)
)


def dumps_params(
    params: PIDParams,
    joint_names: Sequence[str],
    about: Mapping[str, Any] | None = None,
    format: str = "yaml",
) -> str:
    """Return ``params`` as text.

    Parameters
    ----------
    joint_names
        One name per joint.
    about
        Kept with the params for :func:`load_about`, e.g. where they come from: plain numbers,
        strings, lists, mappings.
    format
        "yaml" or "json".

    Raises
    ------
    InvalidArgumentError
        Params of another type, names that do not fit them, or an unknown format.
    """
    instance("params", params, PIDParams, "build them with make_params")
    joints = names("joint_names", joint_names, params.num_joints)
    return documents.render(documents.document(SCHEMA, params.options(), joints, about), format)


def loads_params(
    text: str, joint_names: Sequence[str] | None = None
) -> tuple[PIDParams, list[str]]:
    """Return the params in a text, JSON if it begins with a brace and else YAML; otherwise as
    :func:`load_params`.
    """
    return _build("text", documents.parse_text(text), joint_names)


def save_params(
    path: str | os.PathLike[str],
    params: PIDParams,
    joint_names: Sequence[str],
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write ``params`` to ``path`` (.yaml, .yml or .json), as :func:`dumps_params`.

    An existing file is replaced as a whole or not at all.
    """
    documents.write(path, lambda format: dumps_params(params, joint_names, about, format))


def load_params(
    path: str | os.PathLike[str], joint_names: Sequence[str] | None = None
) -> tuple[PIDParams, list[str]]:
    """Return the params in a file and their joints' names, in the order of ``joint_names`` if
    given.

    Nothing in the file is executed, and every value is checked as in :func:`batchpid.make_params`.

    Raises
    ------
    InvalidArgumentError
        Naming the file, joint and key.
    FileNotFoundError
        The file does not exist.
    """
    return _build(str(path), documents.read(path), joint_names)


def load_about(path: str | os.PathLike[str]) -> Document:
    """Return the ``about`` that :func:`save_params` wrote, or an empty dict. Raises as
    :func:`load_params`.
    """
    document = documents.read(path)
    documents.check(str(path), document, SCHEMA)
    return dict(document.get("about", {}))


def _build(
    source: str, document: Any, joint_names: Sequence[str] | None
) -> tuple[PIDParams, list[str]]:
    """Return the params of a document and the names of their joints."""
    joints = documents.check(source, document, SCHEMA)
    order = list(joints) if joint_names is None else names("joint_names", joint_names)
    missing, unknown = sorted(set(order) - set(joints)), sorted(set(joints) - set(order))
    if missing or unknown:
        problem = f"does not hold these joints: missing {missing}, unknown {unknown}"
        raise InvalidArgumentError(
            source, problem, remedy=f"the file's joints are {', '.join(joints)}"
        )
    for name in order if any("tracking_time" in entry for entry in joints.values()) else ():
        if (
            "back_calculation" in str(joints[name].get("anti_windup"))
            and "tracking_time" not in joints[name]
        ):
            problem = "is missing, while other joints have it"
            raise documents.error(source, "tracking_time", problem, "give it too", name)
    return (
        documents.build(
            source, document, SCHEMA, {name: joints[name] for name in order}, make_params
        ),
        order,
    )
