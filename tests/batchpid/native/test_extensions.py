"""A native extension that was built from other sources or tables is refused, with one message."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import sysconfig
import warnings

import numpy as np
import pytest

import batchpid as bp
from batchpid import native
from batchpid.native import array_program, availability, extensions, operations
from batchpid.native.availability import (
    columns_of,
    every_operation,
    first_difference,
    history_operations,
    program_status,
)
from batchpid.native.extensions import ROOT, StaleExtensionError, load, load_all
from batchpid.native.operations import OPERATIONS, PROGRAM
from batchpid.native.symbols import Namespace, Symbol
from batchpid.native.task_space_extension import TASK_SPACE
from batchpid.native.tracing import trace
from batchpid.sim.engine.native.interface import EXTENSIONS

needs_extension = pytest.mark.skipif(not program_status().active, reason="there are no native programs")
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no compiler")
ALL = {each.name: each for each in (PROGRAM, TASK_SPACE, *EXTENSIONS.values())}
PERMUTED = (*OPERATIONS[:4], *OPERATIONS[5:3:-1], *OPERATIONS[6:])
"""With maximum and minimum exchanged."""


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Reload and recheck the extension, in the test and after it."""
    monkeypatch.delenv("BATCHPID_NATIVE", raising=False)
    caches = load, array_program.interpreter, availability._judged
    for each in caches:
        each.cache_clear()
    yield
    for each in caches:
        each.cache_clear()


def steps():
    """Return the efforts of a few steps of a new controller, and whether it is native."""
    rng, pid = np.random.default_rng(0), bp.BatchPID(bp.make_params(3, 4.0, 5.0, 0.1, effort_limit=9.0), 4, 0.01)
    return [pid(*rng.normal(size=(2, 4, 3))).tobytes() for _ in range(5)], pid.native


@pytest.mark.parametrize("table", ["OPERATIONS", "OPERATION", "MOST_SUMMED"])
def test_the_digest_of_tables_changes_with_each(monkeypatch, table):
    before = PROGRAM.tables_digest()
    others = {"OPERATIONS": PERMUTED, "OPERATION": operations.OPERATION[::-1], "MOST_SUMMED": 256}
    monkeypatch.setattr(operations, table, others[table])
    assert PROGRAM.tables_digest() != before


@pytest.mark.parametrize("name", ALL)
def test_the_digest_changes_with_the_compiler_flags(name):
    assert ALL[name]._replace(flags=("-Ofast",)).tables_digest() != ALL[name].tables_digest()


@pytest.mark.parametrize("name", ALL)
def test_the_digest_changes_with_each_source_file(tmp_path, name):
    extension = ALL[name]
    for file in extension.files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    assert extension.sources_digest(tmp_path) == extension.sources_digest()
    for file in extension.files:
        content = (tmp_path / file).read_bytes()
        (tmp_path / file).write_bytes(content + b"\n")
        assert extension.sources_digest(tmp_path) != extension.sources_digest()
        (tmp_path / file).write_bytes(content)
    (tmp_path / extension.files[0]).unlink()
    assert extension.sources_digest(tmp_path) is None


@pytest.mark.parametrize("name", ALL)
def test_the_sources_are_all_that_are_included(name):
    included, pending = set(), [(ROOT / ALL[name].files[0]).resolve()]
    while pending:
        file = pending.pop()
        included.add(file)
        found = re.findall(r'#include "(.*)"', file.read_text())
        pending += [((ROOT if each.startswith("batchpid/") else file.parent) / each).resolve() for each in found]
    assert included == {(ROOT / file).resolve() for file in ALL[name].files}


@needs_extension
@pytest.mark.parametrize("changed", ["tables", "sources"])
def test_a_stale_extension_is_one_warning_and_numpy_does_the_work(monkeypatch, changed):
    expected = steps()
    assert expected[1]
    load.cache_clear()
    availability._judged.cache_clear()
    monkeypatch.setattr(extensions.Extension, f"{changed}_digest", lambda self: "other")
    reason = f"_program was built from other {changed}; run 'python setup.py build_ext --inplace --force' in "
    with pytest.warns(RuntimeWarning, match=re.escape(reason)) as caught:
        found = steps(), steps()
    assert len(caught) == 1
    assert found == ((expected[0], False),) * 2
    assert program_status().reason.startswith(reason)


def test_the_remedy_without_sources_is_a_new_installation(monkeypatch, tmp_path):
    monkeypatch.setattr(extensions, "ROOT", tmp_path)
    monkeypatch.setattr(extensions.Extension, "sources_digest", lambda self: None)
    if program_status().active:
        assert load_all([PROGRAM])[0].run, "judged by its tables"
    load.cache_clear()
    monkeypatch.setattr(extensions.Extension, "tables_digest", lambda self: "other")
    if program_status().active:
        with pytest.raises(StaleExtensionError, match="install batchpid again"):
            load_all([PROGRAM])


def test_an_extension_that_cannot_be_loaded_is_named(monkeypatch, tmp_path):
    (tmp_path / "_program.abi3.so").write_bytes(b"not a library")
    monkeypatch.delitem(sys.modules, PROGRAM.module, raising=False)
    monkeypatch.setattr(native, "__path__", [str(tmp_path), *native.__path__])
    importlib.invalidate_caches()
    with pytest.warns(RuntimeWarning, match="_program cannot be loaded"):
        assert program_status().reason.startswith("_program cannot be loaded")


def test_an_extension_that_was_not_built_is_no_fault(monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, PROGRAM.module, raising=False)
    monkeypatch.setattr(native, "__path__", [str(tmp_path)])
    importlib.invalidate_caches()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert program_status() == (False, extensions.NOT_BUILT, "")
        assert not steps()[1]


def test_a_variable_switches_native_programs_off(monkeypatch):
    monkeypatch.setenv(availability.SWITCH, "0")
    assert not steps()[1]


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    """Return a function that compiles programs of permuted operations, with digests that are given."""

    def compiled(tables, sources):
        folder = tmp_path_factory.mktemp("build")
        for file in PROGRAM.files:
            code = (ROOT / file).read_text().replace("MAXIMUM, MINIMUM", "MINIMUM, MAXIMUM")
            (folder / file.rpartition("/")[2]).write_text(code)
        library = folder / "_program.abi3.so"
        macros = [f'-DBATCHPID_TABLES="{tables}"', f'-DBATCHPID_SOURCES="{sources}"']
        flags = ["-shared", "-fPIC", "-std=c++17", "-O0", f"-I{sysconfig.get_paths()['include']}"]
        subprocess.run(["g++", *flags, *macros, folder / "program.cpp", "-o", library], check=True)
        return library

    return compiled


def load_instead(monkeypatch, path):
    """Load the library at ``path`` in place of the extension."""
    spec = importlib.util.spec_from_file_location(PROGRAM.module, path)
    monkeypatch.delitem(sys.modules, spec.name)  # loading sets it
    monkeypatch.setitem(sys.modules, spec.name, importlib.util.module_from_spec(spec))
    load.cache_clear()


@pytest.mark.slow
@needs_extension
@needs_compiler
def test_an_extension_of_permuted_operations_is_refused(monkeypatch, build):
    load(PROGRAM)
    with monkeypatch.context() as patch:
        patch.setattr(operations, "OPERATIONS", PERMUTED)
        permuted = build(PROGRAM.tables_digest(), PROGRAM.sources_digest())
    load_instead(monkeypatch, permuted)
    with pytest.warns(RuntimeWarning, match="_program was built from other tables"):
        assert not steps()[1]


@pytest.mark.slow
@needs_extension
@needs_compiler
def test_results_that_differ_are_found_under_the_right_digests(monkeypatch, build):
    load(PROGRAM)
    load_instead(monkeypatch, build(PROGRAM.tables_digest(), PROGRAM.sources_digest()))
    with pytest.warns(RuntimeWarning, match=r"result \d+ of a native program of float64 is not NumPy's"):
        assert not steps()[1]


@needs_extension
def test_the_comparison_with_numpy_makes_every_operation():
    assert first_difference() is None
    namespace = Namespace()
    every_operation(*(Symbol(namespace) for _ in range(4)))
    history_operations(*(Symbol(namespace) for _ in range(4)))
    columns_of(*(Symbol(namespace) for _ in range(3)))
    noted = {name for name, _, _ in namespace.noted}
    numbers = np.frombuffer(trace(every_operation, 0, 4).operations, np.int32).reshape(-1, 5)[:, 0]
    assert noted | {OPERATIONS[number] for number in numbers} == set(OPERATIONS)
