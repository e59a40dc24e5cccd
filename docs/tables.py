"""Write the lists of fields in the guides: ``python docs/tables.py``.

Names, units, bounds and the values for off come from the tables in the code, meanings from the
docstrings there.
"""

from __future__ import annotations

import ast
import inspect
import math
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import batchpid as bp
from batchpid.arrays.array_types import CHOICES
from batchpid.arrays.field_tables import Field, declared
from batchpid.law.params import LAW_FIELDS
from batchpid.motors.actuators import ACTUATOR_FIELDS
from batchpid.sim.findings import OF_FILES, OF_ROBOTS, FindingKind
from batchpid.sim.options.groups import DEFAULT_ENGINE
from batchpid.sim.options.options import OPTION_GROUPS, OPTIONS, RunnerKeywords
from batchpid.sim.randomization.randomization import RANDOMIZED_FIELDS, Randomization

DOCS = Path(__file__).parent


def numpydoc(function: Any) -> Iterator[tuple[list[str], str]]:
    """Yield the names and the description of each entry under Parameters of a function's
    docstring.
    """
    parameters = re.split(r"\n\w+\n-+\n", inspect.getdoc(function) or "")[1]
    for names, text in re.findall(r"^(\S.*)\n((?:    .*\n?)+)", parameters, re.M):
        yield names.split(", "), text


def attributes(owner: type) -> Iterator[tuple[list[str], str]]:
    """Yield the name and the docstring of each attribute of a class."""
    body = ast.parse(inspect.getsource(owner)).body[0].body  # type: ignore[attr-defined]
    for field, text in pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            yield [field.target.id], text.value.value  # type: ignore[attr-defined, union-attr]


def cells(names: list[str], text: str, fields: Mapping[str, Field]) -> tuple[str, ...]:
    """Return names, units, bounds, the values for off, and the first sentence of a description."""
    some = [fields[name] for name in names if name in fields]
    numbers = [field for field in some if isinstance(field.neutral, float)]
    units = dict.fromkeys(field.unit for field in some if field.unit)
    bounds = dict.fromkeys(bound(field) for field in numbers)
    off = dict.fromkeys(shown(field.neutral) for field in some)
    off |= {f"`{next(iter(CHOICES[name]))}`": None for name in names if name in CHOICES}
    meaning = re.sub(r" \[[^]`]*\]|,? >=? 0(?=[ ,.]|$)", "", " ".join(text.split()))
    columns = [f"`{name}`" for name in names], units, bounds, off
    return *(", ".join(column) for column in columns), first_sentence(meaning)


def first_sentence(text: str) -> str:
    """Return the first sentence of a docstring, in Markdown."""
    plain = re.sub(r":\w+:|\*", "", " ".join(text.split())).replace("``", "`")
    return re.match(r".*?(?<!e\.g)(?=\. |\.?$)", plain)[0]  # type: ignore[index]


ADVANCED = (
    *("wrenches", "build", "backend", "on_invalid_input", "first_env"),
    *("timeout", "cluster"),
)
"""Options of the Runner that few programs need."""


def option_texts() -> Iterator[tuple[str, str]]:
    """Yield the name and the text of each option of the Runner."""
    for group in (RunnerKeywords, *OPTION_GROUPS):
        for (name,), text in attributes(group):
            yield name, text


def advanced() -> str:
    """Return a paragraph about the advanced options."""
    texts = dict(option_texts())
    entries = [f"`{name}` ({first_sentence(texts[name])})" for name in ADVANCED]
    return textwrap.fill(f"Few programs need the others: {'; '.join(entries)}.", 120)


def options() -> str:
    """Return the list of the Runner's options, with their defaults and the places that keep them."""
    defaults = {each.name: each.default for each in fields(RunnerKeywords)}
    bounds = declared(RunnerKeywords, Field)
    rows = []
    for name, text in option_texts():
        if name in ADVANCED:
            continue
        details = []
        if name in bounds:
            details.append(bound(bounds[name]))
        if defaults[name] not in (MISSING, DEFAULT_ENGINE):
            details.append(f"default `{defaults[name]}`")
        if OPTIONS[name].places:
            details.append(f"kept in {', '.join(OPTIONS[name].places)}")
        if OPTIONS[name].flag:
            details.append(f"`--{'no-' * (defaults[name] is True)}{name}`")
        rows.append((f"`{name}`", "; ".join(details), first_sentence(text)))
    return items(rows)


def findings(kinds: tuple[FindingKind, ...], done: str) -> str:
    """Return the list of kinds of findings: when they are made, and what is ``done``."""
    return items(
        [
            (f"`{kind.code}`", "", f"{_escaped(kind.when)}. {done}: {_escaped(kind.done)}")
            for kind in kinds
        ]
    )


def items(rows: Iterable[tuple[str, str, str]]) -> str:
    """Return a list in Markdown: a name, details in brackets, and its meaning in each item."""
    texts = []
    for name, details, meaning in rows:
        brackets = f" ({details})" if details else ""
        text = f"- {name}{brackets}: {meaning}"
        texts += textwrap.wrap(text, 120, subsequent_indent="  ", break_on_hyphens=False)
    return "\n".join(texts)


def _escaped(text: str) -> str:
    """Return a sentence in Markdown: tags stand in code."""
    return re.sub(r"(?<!`)(<[^`>]*>)", r"`\1`", text)


def bound(field: Field) -> str:
    """Return the bounds of a field."""
    if math.isfinite(field.high):
        return f"{field.low:g} to {field.high:g}"
    return "any" if math.isinf(field.low) else f"{'>' if field.above else '>='} {field.low:g}"


def shown(neutral: Any) -> str:
    """Return a value that is off."""
    return f"{neutral:g}" if isinstance(neutral, float) else f"`{neutral}`"


def table(
    entries: Iterator[tuple[list[str], str]],
    fields: Mapping[str, Field],
    without: tuple[str, ...],
    off: bool = True,
) -> str:
    """Return a list in Markdown, with the values that are ``off``."""
    rows = []
    for names, text in entries:
        if names[0] in without:
            continue
        name, unit, range_, neutral, meaning = cells(names, text, fields)
        details = [part for part in (unit, range_, f"off: {neutral}" if off else "") if part]
        rows.append((name, "; ".join(details), meaning))
    return items(rows)


def tables() -> dict[tuple[str, str], str]:
    """Return the tables by page and name."""
    without = "joints", "joint_names", "dtype"
    return {
        ("law.md", "params"): table(numpydoc(bp.make_params), LAW_FIELDS, without),
        ("actuators.md", "actuators"): table(numpydoc(bp.make_actuators), ACTUATOR_FIELDS, without),
        ("randomization.md", "randomization"): table(
            attributes(Randomization), RANDOMIZED_FIELDS, ("seed", "per"), off=False
        ),
        ("runner.md", "options"): options(),
        ("runner.md", "advanced"): advanced(),
        ("robots.md", "files"): findings(OF_FILES, "Simulated"),
        ("robots.md", "preflight"): findings(OF_ROBOTS, "Remedy"),
    }


def pages() -> dict[Path, str]:
    """Return the text of each page with its tables."""
    texts: dict[Path, str] = {}
    for (page, name), rows in tables().items():
        path = DOCS / page
        text = texts.get(path) or path.read_text()
        marked = re.compile(rf"(<!-- {name}: made by docs/tables.py -->\n).*?(<!-- end -->)", re.S)
        text, count = marked.subn(lambda match, rows=rows: f"{match[1]}{rows}\n{match[2]}", text)
        assert count == 1, (page, name)
        texts[path] = text
    return texts


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text)
