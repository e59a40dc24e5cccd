"""A native extension that was built from other sources or tables is refused, with one message."""

from __future__ import annotations

import ctypes
import importlib.util
import pickle
import re
import shutil
import subprocess
import sys
import sysconfig
import threading
import warnings

import numpy as np
import pytest
from identical import assert_identical

from sim import Runner
from sim.engine import native, native_self_test
from sim.engine.array_program import Namespace, Symbol
from sim.engine.batch_dynamics import PinocchioBatchDynamics, batch_dynamics
from sim.engine.native import interface, loading, verdict
from sim.engine.native.interface import EXTENSIONS, FOLDER, sources_digest, tables_digest

needs_extension = pytest.mark.skipif(not native.status().active, reason="there are no native calls")
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="there is no compiler")
OTHERS = {
    "SYMBOLS": interface.SYMBOLS[::-1],
    "STATUS": interface.STATUS[::-1],
    "BODY": interface.BODY | {"mass": 2},
    "DYNAMICS": interface.DYNAMICS[::-1],
    "STEP": interface.STEP[::-1],
    "OPERATIONS": interface.OPERATIONS[:4] + interface.OPERATIONS[5:3:-1] + interface.OPERATIONS[6:],
    "OPERATION": interface.OPERATION[::-1],
    "MOST_SUMMED": 256,
    "Group": type("Group", (ctypes.Structure,), {"_fields_": interface.Group._fields_[::-1]}),
}
USERS = {
    "_gateway": {"SYMBOLS", "STATUS", "BODY", "Group"},
    "_batch_dynamics": {"BODY", "DYNAMICS", "STEP"},
    "_law_program": {"OPERATIONS", "OPERATION", "MOST_SUMMED"},
}


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Let extensions be loaded and judged anew, in the test and after it."""
    monkeypatch.delenv("BATCHPID_NATIVE_VERIFIED", raising=False)
    monkeypatch.setattr(verdict, "_verdict", None)
    loading.extension.cache_clear()
    yield
    loading.extension.cache_clear()


def rollout(panda, workers=0, runners=1):
    """Return a rollout of two robots, and the backend, of the last of some runners."""
    setpoint = np.clip(panda.start + 0.02, panda.lower, panda.upper)
    for _ in range(runners):
        with Runner(panda, 2, workers=workers, substeps=5) as runner:
            found = runner.rollout(np.tile(setpoint, (4, 2, 1))), runner.backend
    return found


@pytest.mark.parametrize("table", OTHERS)
def test_the_digest_of_tables_changes_with_each(monkeypatch, table):
    before = {name: tables_digest(name) for name in EXTENSIONS}
    monkeypatch.setattr(interface, table, OTHERS[table])
    changed = {name for name in EXTENSIONS if tables_digest(name) != before[name]}
    assert changed == {name for name, tables in USERS.items() if table in tables}


@pytest.mark.parametrize("name", EXTENSIONS)
def test_the_digest_changes_with_the_compiler_flags(monkeypatch, name):
    before = tables_digest(name)
    monkeypatch.setitem(EXTENSIONS, name, EXTENSIONS[name]._replace(flags=("-Ofast",)))
    assert tables_digest(name) != before


@pytest.mark.parametrize("name", EXTENSIONS)
def test_the_digest_changes_with_each_source_file(tmp_path, name):
    unit, headers, _ = EXTENSIONS[name]
    for file in (unit, *headers):
        shutil.copy(FOLDER / file, tmp_path)
    assert sources_digest(name, tmp_path) == sources_digest(name)
    for file in (unit, *headers):
        content = (tmp_path / file).read_bytes()
        (tmp_path / file).write_bytes(content + b"\n")
        assert sources_digest(name, tmp_path) != sources_digest(name)
        (tmp_path / file).write_bytes(content)
    (tmp_path / unit).unlink()
    assert sources_digest(name, tmp_path) is None


@pytest.mark.parametrize("name", EXTENSIONS)
def test_the_sources_are_all_that_are_included(name):
    unit, headers, _ = EXTENSIONS[name]
    included, pending = set(), [unit]
    while pending:
        found = set(re.findall(r'#include "(.*)"', (FOLDER / pending.pop()).read_text())) - included
        included |= found
        pending += found
    assert included == set(headers)


@needs_extension
@pytest.mark.parametrize("changed", ["tables", "sources"])
@pytest.mark.parametrize("name", EXTENSIONS)
def test_a_stale_extension_is_one_warning_and_python_does_the_work(monkeypatch, panda, name, changed):
    expected, _ = rollout(panda)
    loading.extension.cache_clear()
    monkeypatch.setattr(verdict, "_verdict", None)
    real = getattr(loading, f"{changed}_digest")
    monkeypatch.setattr(loading, f"{changed}_digest", lambda asked: "other" if asked == name else real(asked))
    reason = f"{name} was built from other {changed}; run 'python setup.py build_ext --inplace --force' in "
    with pytest.warns(RuntimeWarning, match=re.escape(reason)) as caught:
        found, backend = rollout(panda, runners=2)
    assert len(caught) == 1
    assert backend.startswith(f"law in NumPy, Python calls into SAPIEN ({reason}")
    assert_identical(expected, found)
    assert isinstance(batch_dynamics(panda, (0, 1)), PinocchioBatchDynamics)
    (variable, told), *others = native.environment().items()
    assert (variable, others) == ("BATCHPID_NATIVE_REFUSED", [])
    assert told in backend


@needs_extension
def test_worker_processes_take_the_verdict_without_a_warning_of_their_own(monkeypatch, panda, capfd):
    monkeypatch.setattr(loading, "tables_digest", lambda name: "other")
    with pytest.warns(RuntimeWarning, match="_gateway was built from other tables, _batch"):
        expected, _ = rollout(panda)
    found, _ = rollout(panda, workers=2)
    assert_identical(expected, found)
    assert "Warning" not in capfd.readouterr().err


def test_the_remedy_without_sources_is_a_new_installation(monkeypatch, tmp_path):
    monkeypatch.setattr(loading, "FOLDER", tmp_path)
    assert loading.remedy() == "install batchpid again"
    monkeypatch.setattr(loading, "sources_digest", lambda name: sources_digest(name, tmp_path))
    if native.status().active:
        assert loading.extensions().keys() == EXTENSIONS.keys()  # judged by their tables


def test_an_extension_that_cannot_be_loaded_is_named(monkeypatch, tmp_path):
    broken = tmp_path / "_law_program.abi3.so"
    broken.write_bytes(b"not a library")
    monkeypatch.delitem(sys.modules, "sim.engine.native._law_program", raising=False)
    monkeypatch.setattr(native, "__path__", [str(tmp_path), *native.__path__])
    importlib.invalidate_caches()
    with pytest.raises(ImportError, match="cannot be loaded"):
        loading.extension("_law_program")
    status = native.verify(tmp_path)
    assert status.reason.startswith("_law_program cannot be loaded")
    assert status.warning


def test_an_extension_that_was_not_built_is_no_fault(monkeypatch, tmp_path):
    monkeypatch.delenv("BATCHPID_NATIVE", raising=False)
    monkeypatch.delitem(sys.modules, "sim.engine.native._law_program", raising=False)
    monkeypatch.setattr(native, "__path__", [str(tmp_path)])
    importlib.invalidate_caches()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert native.status() == (False, loading.NOT_BUILT, "")


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    """Return a function that compiles a program of permuted operations, with digests that are given."""

    def compiled(tables, sources):
        folder = tmp_path_factory.mktemp("build")
        code = (FOLDER / "law_program.cpp").read_text().replace("MAXIMUM, MINIMUM", "MINIMUM, MAXIMUM")
        (folder / "law_program.cpp").write_text(code)
        library = folder / "_law_program.abi3.so"
        macros = [f'-DBATCHPID_TABLES="{tables}"', f'-DBATCHPID_SOURCES="{sources}"']
        include = [f"-I{FOLDER}", f"-I{sysconfig.get_paths()['include']}"]
        flags = ["-shared", "-fPIC", "-std=c++17", "-O0"]
        subprocess.run(["g++", *flags, *macros, *include, folder / "law_program.cpp", "-o", library], check=True)
        return library

    return compiled


def load(monkeypatch, path):
    """Load the library at ``path`` in place of the extension."""
    spec = importlib.util.spec_from_file_location("sim.engine.native._law_program", path)
    monkeypatch.delitem(sys.modules, spec.name)  # loading sets it
    monkeypatch.setitem(sys.modules, spec.name, importlib.util.module_from_spec(spec))


@needs_extension
@needs_compiler
def test_an_extension_of_permuted_operations_is_refused(monkeypatch, build, panda):
    expected, _ = rollout(panda)
    with monkeypatch.context() as patch:
        patch.setattr(interface, "OPERATIONS", OTHERS["OPERATIONS"])
        permuted = build(tables_digest("_law_program"), sources_digest("_law_program"))
    load(monkeypatch, permuted)
    monkeypatch.setattr(verdict, "_verdict", None)
    loading.extension.cache_clear()
    with pytest.warns(RuntimeWarning, match="_law_program was built from other tables") as caught:
        found, backend = rollout(panda)
    assert len(caught) == 1
    assert "law in NumPy" in backend
    assert_identical(expected, found)


@needs_extension
@needs_compiler
def test_the_self_test_finds_permuted_operations_under_the_right_digests(build, tmp_path):
    permuted = build(tables_digest("_law_program"), sources_digest("_law_program"))
    program = (
        "import importlib.util, json, sys; sys.path[:] = json.loads(sys.argv[1]); "
        f"spec = importlib.util.spec_from_file_location('sim.engine.native._law_program', {str(permuted)!r}); "
        "sys.modules[spec.name] = importlib.util.module_from_spec(spec); "
        "from sim.engine import native_self_test; native_self_test._compare_programs()"
    )
    status = native.verify(tmp_path, program)
    assert not status.active
    assert re.search(
        r"the self-test failed: AssertionError: result \d+ of a native program is not NumPy's", status.reason
    )


def test_the_self_test_makes_every_operation():
    namespace = Namespace()
    native_self_test.every_operation(*(Symbol(namespace) for _ in range(4)))
    assert {name for name, _, _ in namespace.noted} == set(interface.OPERATIONS)


@needs_extension
def test_two_threads_run_the_self_test_once(monkeypatch, tmp_path):
    runs, gate = [], threading.Barrier(4)

    def verify(folder):
        runs.append(folder)
        return native.NativeStatus(True)

    def ask():
        gate.wait()
        assert native.status().active

    monkeypatch.setattr(verdict, "verify", verify)
    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(runs) == 1


def test_a_process_of_a_pool_takes_the_verdict_of_its_parent(monkeypatch, tmp_path):
    monkeypatch.setenv("BATCHPID_NATIVE_REFUSED", "")
    pickle.loads(pickle.dumps(native.take_verdict))({"BATCHPID_NATIVE_REFUSED": "the parent's reason"})
    assert native.verify(tmp_path) == (False, "the parent's reason", "")
