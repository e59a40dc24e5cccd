"""Results of an export and of an import."""

from __future__ import annotations

from typing import NamedTuple

from batchpid.law.params import PIDParams


class Exported(NamedTuple):
    """Text of a file for a target, and the differences of the target's law from :func:`batchpid.step`."""

    text: str
    differences: tuple[str, ...] = ()
    """One sentence each; empty where the target computes the same law."""


class Imported(NamedTuple):
    """Params, the names of their joints, and the differences of the law from the file."""

    params: PIDParams
    joint_names: list[str]
    differences: tuple[str, ...] = ()
