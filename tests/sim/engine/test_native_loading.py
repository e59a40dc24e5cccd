"""Native code that cannot be used is refused by one sentence in ``Runner.backend``, and Python does
the work.
"""

import ctypes
import re

import numpy as np
import pytest
from identical import assert_identical

from batchpid.native import array_program, extensions
from batchpid.native.extensions import PROGRAM, load
from batchpid.sim import Runner
from batchpid.sim.engine import native
from batchpid.sim.engine.native import EXTENSIONS, structure
from batchpid.sim.engine.sapien import calls

needs_extension = pytest.mark.skipif(bool(native.obstacle()), reason="there are no native calls")


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Reload and recheck extensions, in the test and after it."""
    monkeypatch.delenv("BATCHPID_NATIVE", raising=False)
    caches = extensions.load, array_program._fault, calls.functions
    for cache in caches:
        cache.cache_clear()
    yield
    for cache in caches:
        cache.cache_clear()


def rollout(panda, workers=0, runners=1, engine="sapien"):
    """Return a rollout of two robots, and the backend, of the last of some runners."""
    setpoint = np.clip(panda.start + 0.02, panda.lower, panda.upper)
    for _ in range(runners):
        with Runner(panda, 2, workers=workers, substeps=5, engine=engine) as runner:
            found = runner.rollout(np.tile(setpoint, (4, 2, 1))), runner.backend
    return found


def make_stale(monkeypatch, module):
    """Pretend that the extension ``module`` was built from other sources."""
    real = extensions.Extension.digests
    monkeypatch.setattr(
        extensions.Extension,
        "digests",
        lambda self: ["flags=other"] if self.module == module else real(self),
    )
    extensions.load.cache_clear()
    array_program._fault.cache_clear()


@needs_extension
@pytest.mark.parametrize("module", [PROGRAM.module, *(each.module for each in EXTENSIONS.values())])
def test_a_stale_extension_is_one_warning_and_python_does_the_work(monkeypatch, panda, module):
    expected, _ = rollout(panda)
    make_stale(monkeypatch, module)
    reason = f"{module.rpartition('.')[2]} was built from other sources (flags); "
    reason += "run 'python setup.py build_ext --inplace --force' in "
    with pytest.warns(RuntimeWarning) as caught:
        found, backend = rollout(panda, runners=2)
    assert [reason in str(each.message) for each in caught] == [True]
    assert backend.startswith(f"law in NumPy, Python calls into SAPIEN ({reason}")
    assert_identical(expected, found)


@needs_extension
def test_worker_processes_give_no_warning_of_their_own(monkeypatch, panda, capfd):
    make_stale(monkeypatch, PROGRAM.module)
    with pytest.warns(RuntimeWarning, match="_program was built from other sources"):
        expected, _ = rollout(panda)
    found, _ = rollout(panda, workers=2)
    assert_identical(expected, found)
    assert "Warning" not in capfd.readouterr().err


@needs_extension
@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        (
            "TESTED",
            ("3.0.0",),
            r"native calls are not tested with SAPIEN \S+; install sapien==3.0.0",
        ),
        (
            "SYMBOLS",
            {"step": "_ZN6sapien4noneEv"},
            r"SAPIEN \S+ has another library: .*_ZN6sapien4noneEv; install sapien==",
        ),
    ],
    ids=["version", "symbols"],
)
def test_another_sapien_is_refused_by_name(monkeypatch, panda, name, value, reason):
    expected, _ = rollout(panda)
    monkeypatch.setattr(calls, name, value)
    calls.functions.cache_clear()
    found, backend = rollout(panda)
    assert_identical(expected, found)
    assert re.fullmatch(rf"law in NumPy, Python calls into SAPIEN \({reason}.*\)", backend)
    assert rollout(panda, engine="mujoco")[1] == "law as a native program, native calls into MuJoCo"


@needs_extension
def test_structures_of_python_have_the_places_and_sizes_of_the_compiler():
    fields = load(EXTENSIONS["_gateway"]).fields
    assert {name for name, *_ in fields} >= {"Group", "Mujoco", "Stage", "Tick"}
    for name, field, _, _, place, size in fields:
        kind = structure(name)
        assert (getattr(kind, field).offset, ctypes.sizeof(kind)) == (place, size)


@needs_extension
def test_a_mujoco_without_the_functions_is_refused_by_name(monkeypatch, panda):
    step = pytest.importorskip("batchpid.sim.engine.mujoco.mujoco_step")
    monkeypatch.setattr(step, "functions", lambda: None)
    _, backend = rollout(panda, engine="mujoco")
    assert "Python calls into MuJoCo (MuJoCo " in backend
    assert backend.endswith(" lacks functions for native calls)")
