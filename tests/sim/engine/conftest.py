"""Fixtures of the tests of batchpid.sim.engine."""

from __future__ import annotations

import pytest

from batchpid.sim.engine.sapien.pack import Pack


class Packs(list[Pack]):
    """Packs built in this process."""

    def isolated(self) -> int:
        """Return how many robots of the packs in use have a system to themselves because contact was predicted."""
        return sum(int(pack.isolated.sum()) for pack in self if pack.robots)


@pytest.fixture
def packs(monkeypatch: pytest.MonkeyPatch) -> Packs:
    """Packs built in this process from now on, to look at behind a Runner with ``workers=0``."""
    packs, init = Packs(), Pack.__init__

    def record(pack, *args, **options):
        init(pack, *args, **options)
        packs.append(pack)

    monkeypatch.setattr(Pack, "__init__", record)
    return packs
