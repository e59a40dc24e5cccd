"""Registration of the extension's functions in JAX."""

from __future__ import annotations

import threading
import time

import pytest

from batchpid.sim.engine import native
from batchpid.sim.engine.native import xla

jax = pytest.importorskip("jax")


@pytest.mark.skipif(bool(native.obstacle()), reason="there are no native calls")
def test_two_threads_register_the_functions_once(monkeypatch):
    xla.obstacle()
    taken, gate = list[str](), threading.Barrier(2)

    def register(name, *_, **__):
        time.sleep(0.01)  # lets the other thread run
        if name in taken:
            raise ValueError(f"{name} is registered")
        taken.append(name)

    def ask():
        gate.wait()
        found.append(xla.obstacle())

    found = []
    monkeypatch.setattr(jax.ffi, "register_ffi_target", register)
    xla._registered.cache_clear()
    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == ["", ""]
