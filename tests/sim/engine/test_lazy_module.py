"""SAPIEN's loader is imported without the packages for meshes that are not loaded here, and still has them."""

import subprocess
import sys

import pytest

from batchpid.sim.engine.sapien.building import LazyModule, imported_lazily

PROGRAM = """
import sys
import batchpid.sim.engine.sapien.building
assert not {"trimesh", "scipy"} & sys.modules.keys(), "a worker starts without them"
import sapien.wrapper.urchin.utils as urchin
import trimesh
assert urchin.trimesh.Trimesh is trimesh.Trimesh
"""


@pytest.mark.slow
def test_the_engine_is_imported_without_trimesh():
    pytest.importorskip("trimesh")
    subprocess.run([sys.executable, "-W", "ignore", "-c", PROGRAM], check=True, timeout=100)


def test_a_package_is_imported_at_its_first_use(tmp_path, monkeypatch):
    (tmp_path / "slow_package.py").write_text("ANSWER = 42")
    monkeypatch.syspath_prepend(tmp_path)
    with imported_lazily("slow_package"):
        import slow_package as lazy
    assert isinstance(lazy, LazyModule)
    assert "slow_package" not in sys.modules
    assert lazy.ANSWER == 42
    with imported_lazily("slow_package"):
        import slow_package
    assert not isinstance(slow_package, LazyModule)
    with imported_lazily("no_package"):
        import no_package

        with pytest.raises(ModuleNotFoundError):
            _ = no_package.name
