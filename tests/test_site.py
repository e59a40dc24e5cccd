"""The pages that `make docs` builds: every public name is in the reference, and every link has a
target.
"""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
INTERNAL = {"batchpid.sim.engine.native"}
PACKAGES = sorted(
    ".".join(path.parent.relative_to(ROOT).parts)
    for folder in ("batchpid", "batchpid/sim")
    for path in (ROOT / folder).rglob("__init__.py")
    if "__all__ = " in path.read_text()
)
PACKAGES = [package for package in PACKAGES if package not in INTERNAL]
REFERENCE = {
    name
    for page in (ROOT / "docs/api").glob("*.md")
    for name in re.findall(r"^::: (.*)$", page.read_text(), re.M)
}


def test_the_packages_with_public_names_are_found():
    rooms = ("motors", "sim", "sim.plots", "sim.identification", "sim.view")
    assert {"batchpid", *(f"batchpid.{room}" for room in rooms)} <= set(PACKAGES)


def places(package, name):
    """Return the entries of the reference that would show a public name: its own, its package's, or
    its module's.
    """
    value = getattr(importlib.import_module(package), name)
    if isinstance(value, ModuleType):
        return {value.__name__}
    if not hasattr(value, "__qualname__"):  # a constant does not say where it is defined
        shown = {
            each for each in REFERENCE if each.startswith(f"{package}.") and each in sys.modules
        }
        return {
            package,
            *(each for each in shown if getattr(sys.modules[each], name, None) is value),
        }
    return {f"{package}.{name}", package, value.__module__, f"{value.__module__}.{name}"}


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_in_the_reference(package):
    names = importlib.import_module(package).__all__
    assert [name for name in names if not places(package, name) & REFERENCE] == []


def test_the_docs_are_built_with_their_warnings():
    """--quiet keeps warnings from --strict, which then passes with dead links."""
    recipe = re.search(r"^docs:.*\n\t(.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)[1]
    assert "--strict" in recipe
    assert "quiet" not in recipe


def test_the_tables_of_fields_are_those_of_the_code():
    spec = importlib.util.spec_from_file_location("tables", ROOT / "docs/tables.py")
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
    old = [path.name for path, text in tables.pages().items() if path.read_text() != text]
    assert old == [], "run python docs/tables.py"


def test_no_page_is_too_long():
    for page in (ROOT / "docs").rglob("*.md"):
        assert len(page.read_text().splitlines()) <= 305, page
