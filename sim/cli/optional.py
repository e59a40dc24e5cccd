"""Flags that may be left out: their help says in words what happens then, so "(default: None)" is not added."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

_LEFT_OUT = tyro.conf.arg(help_behavior_hint=lambda default: "" if default == "None" else f"(default: {default})")

OptionalPath = Annotated[Path | None, _LEFT_OUT]
OptionalStr = Annotated[str | None, _LEFT_OUT]
OptionalInt = Annotated[int | None, _LEFT_OUT]
OptionalFloat = Annotated[float | None, _LEFT_OUT]
OptionalFloats = Annotated[tuple[float, ...] | None, tyro.conf.arg(metavar="FLOAT [FLOAT ...]", help_behavior_hint="")]
Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]", help_behavior_hint="")]
