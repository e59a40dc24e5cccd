"""A native extension that was built from other sources or tables is refused, with one message."""

from __future__ import annotations

import ctypes
import importlib
import pickle
import re
import sys
import threading
import warnings

import numpy as np
import pytest
from identical import assert_identical

from batchpid.native import extensions
from batchpid.native.operations import PROGRAM
from batchpid.sim import Runner
from batchpid.sim.engine import native
from batchpid.sim.engine.native import interface, verdict
from batchpid.sim.engine.native.interface import EXTENSIONS

needs_extension = pytest.mark.skipif(not native.status().active, reason="there are no native calls")
OTHERS = {
    "SYMBOLS": interface.SYMBOLS[::-1],
    "STATUS": interface.STATUS[::-1],
    "BODY": interface.BODY | {"mass": 2},
    "Tick": type("Tick", (ctypes.Structure,), {"_fields_": interface.Tick._fields_[::-1]}),
    "Group": type("Group", (ctypes.Structure,), {"_fields_": interface.Group._fields_[::-1]}),
}
USERS = {
    "_gateway": {"SYMBOLS", "STATUS", "BODY", "Tick", "Group"},
}


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Reload and recheck extensions, in the test and after it."""
    monkeypatch.delenv("BATCHPID_NATIVE_VERIFIED", raising=False)
    monkeypatch.setattr(verdict, "_verdict", None)
    extensions.load.cache_clear()
    yield
    extensions.load.cache_clear()


def rollout(panda, workers=0, runners=1):
    """Return a rollout of two robots, and the backend, of the last of some runners."""
    setpoint = np.clip(panda.start + 0.02, panda.lower, panda.upper)
    for _ in range(runners):
        with Runner(panda, 2, workers=workers, substeps=5) as runner:
            found = runner.rollout(np.tile(setpoint, (4, 2, 1))), runner.backend
    return found


@pytest.mark.parametrize("table", OTHERS)
def test_the_digest_of_tables_changes_with_each(monkeypatch, table):
    before = {name: each.tables_digest() for name, each in EXTENSIONS.items()}
    monkeypatch.setattr(interface, table, OTHERS[table])
    changed = {name for name, each in EXTENSIONS.items() if each.tables_digest() != before[name]}
    assert changed == {name for name, tables in USERS.items() if table in tables}


@needs_extension
@pytest.mark.parametrize("changed", ["tables", "sources"])
@pytest.mark.parametrize("name", [*EXTENSIONS, PROGRAM.name])
def test_a_stale_extension_is_one_warning_and_python_does_the_work(monkeypatch, panda, name, changed):
    expected, _ = rollout(panda)
    extensions.load.cache_clear()
    monkeypatch.setattr(verdict, "_verdict", None)
    method = f"{changed}_digest"
    real = getattr(extensions.Extension, method)
    monkeypatch.setattr(extensions.Extension, method, lambda self: "other" if self.name == name else real(self))
    reason = f"{name} was built from other {changed}; run 'python setup.py build_ext --inplace --force' in "
    with pytest.warns(RuntimeWarning, match=re.escape(reason)) as caught:
        found, backend = rollout(panda, runners=2)
    assert len(caught) == 1
    assert backend.startswith(f"law in NumPy, Python calls into SAPIEN ({reason}")
    assert_identical(expected, found)
    (variable, told), *others = native.environment().items()
    assert (variable, others) == ("BATCHPID_NATIVE_REFUSED", [])
    assert told in backend


@needs_extension
def test_worker_processes_take_the_verdict_without_a_warning_of_their_own(monkeypatch, panda, capfd):
    monkeypatch.setattr(extensions.Extension, "tables_digest", lambda self: "other")
    with pytest.warns(RuntimeWarning, match="_gateway was built from other tables"):
        expected, _ = rollout(panda)
    found, _ = rollout(panda, workers=2)
    assert_identical(expected, found)
    assert "Warning" not in capfd.readouterr().err


def test_an_extension_that_was_not_built_is_no_fault(monkeypatch, tmp_path):
    monkeypatch.delenv("BATCHPID_NATIVE", raising=False)
    monkeypatch.delitem(sys.modules, "batchpid.sim.engine.native._gateway", raising=False)
    monkeypatch.setattr(native, "__path__", [str(tmp_path)])
    importlib.invalidate_caches()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert native.status() == (False, extensions.NOT_BUILT, "")


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
