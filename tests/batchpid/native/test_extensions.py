"""A native extension that was built from other sources is refused, with one message."""

import importlib
import re
import shutil
import sys
import warnings

import numpy as np
import pytest

import batchpid as bp
from batchpid import native
from batchpid.native import array_program, extensions
from batchpid.native.array_program import obstacle
from batchpid.native.extensions import PROGRAM, ROOT, TASK_SPACE, load
from batchpid.sim.engine.native import EXTENSIONS

needs_extension = pytest.mark.skipif(bool(obstacle()), reason="there is no native code")
needs_sources = pytest.mark.skipif(
    not (ROOT / PROGRAM.files[0]).is_file(), reason="a wheel has no C++ files"
)
ALL = {each.module: each for each in (PROGRAM, TASK_SPACE, *EXTENSIONS.values())}


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    """Reload and recheck the extension, in the test and after it."""
    monkeypatch.delenv("BATCHPID_NATIVE", raising=False)
    caches = load, array_program.interpreter, array_program._fault
    for each in caches:
        each.cache_clear()
    yield
    for each in caches:
        each.cache_clear()


def steps():
    """Return the efforts of a few steps of a new controller, and whether it is native."""
    rng, pid = (
        np.random.default_rng(0),
        bp.BatchPID(bp.make_params(3, 4.0, 5.0, 0.1, effort_limit=9.0), 4, 0.01),
    )
    return [pid(*rng.normal(size=(2, 4, 3))).tobytes() for _ in range(5)], pid.native


@needs_sources
@pytest.mark.parametrize("name", ALL)
def test_a_digest_changes_with_its_file_alone(name, tmp_path):
    extension = ALL[name]
    before = extension.digests()
    assert len(before) == 1 + len(set(extension.files))
    for file in extension.files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / file, tmp_path / file)
    assert extension.digests(tmp_path) == before
    for file in set(extension.files):
        content = (tmp_path / file).read_bytes()
        (tmp_path / file).write_bytes(content + b"\n")
        (changed,) = set(before) - set(extension.digests(tmp_path))
        assert changed.partition("=")[0] == file
        (tmp_path / file).write_bytes(content)
    flags = extension._replace(flags=("-Ofast",)).digests()
    assert flags[0] != before[0]
    assert flags[1:] == before[1:]


@needs_sources
@pytest.mark.parametrize("name", ALL)
def test_the_files_are_all_that_are_included_and_the_tables(name):
    included, pending = set(), [(ROOT / ALL[name].files[0]).resolve()]
    while pending:
        file = pending.pop()
        included.add(file)
        found = re.findall(r'#include "(.*)"', file.read_text())
        pending += [
            ((ROOT if each.startswith("batchpid/") else file.parent) / each).resolve()
            for each in found
        ]
    files = {(ROOT / file).resolve() for file in ALL[name].files}
    assert included == {file for file in files if file.suffix != ".py"}
    assert any(file.suffix == ".py" for file in files)


def other_file(monkeypatch, changed):
    """Change the digests of the files that end with ``changed``."""
    real = extensions.Extension.digests
    monkeypatch.setattr(
        extensions.Extension,
        "digests",
        lambda self: [
            each + ("0" if each.partition("=")[0].endswith(changed) else "") for each in real(self)
        ],
    )


@needs_extension
@needs_sources
@pytest.mark.parametrize("file", ["native/program.h", "native/extensions.py", "flags"])
def test_a_stale_extension_is_one_warning_and_numpy_does_the_work(monkeypatch, file):
    expected = steps()
    assert expected[1]
    load.cache_clear()
    array_program._fault.cache_clear()
    other_file(monkeypatch, file)
    reason = rf"_program was built from other sources \(\S*{file}\); "
    reason += "run 'python setup.py build_ext --inplace --force' in "
    with pytest.warns(RuntimeWarning, match=reason) as caught:
        found = steps(), steps()
    assert len(caught) == 1
    assert found == ((expected[0], False),) * 2
    assert re.match(reason, obstacle())


@needs_extension
def test_without_sources_the_tables_decide_and_the_remedy_is_a_new_installation(
    monkeypatch, tmp_path
):
    real = extensions.Extension.digests
    tables = tmp_path / "batchpid/native/extensions.py"
    tables.parent.mkdir(parents=True)
    shutil.copy(ROOT / "batchpid/native/extensions.py", tables)
    monkeypatch.setattr(extensions, "ROOT", tmp_path)
    monkeypatch.setattr(extensions.Extension, "digests", lambda self: real(self, tmp_path))
    assert load(PROGRAM).run
    load.cache_clear()
    tables.write_text("other")
    with pytest.warns(
        RuntimeWarning, match=r"\(batchpid/native/extensions.py\); install batchpid again"
    ):
        assert obstacle()


def test_an_extension_that_cannot_be_loaded_is_named(monkeypatch, tmp_path):
    (tmp_path / "_program.abi3.so").write_bytes(b"not a library")
    monkeypatch.delitem(sys.modules, PROGRAM.module, raising=False)
    monkeypatch.setattr(native, "__path__", [str(tmp_path), *native.__path__])
    importlib.invalidate_caches()
    with pytest.warns(RuntimeWarning, match="_program cannot be loaded"):
        assert obstacle().startswith("_program cannot be loaded")


def test_an_extension_that_was_not_built_is_no_fault(monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, PROGRAM.module, raising=False)
    monkeypatch.setattr(native, "__path__", [str(tmp_path)])
    importlib.invalidate_caches()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert obstacle() == extensions.NOT_BUILT
        assert not steps()[1]


def test_a_variable_switches_native_programs_off(monkeypatch):
    monkeypatch.setenv(array_program.SWITCH, "0")
    assert not steps()[1]
