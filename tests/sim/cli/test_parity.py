"""The command parity finds that both engines move a panda alike."""

import json

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("mujoco.batch")


@pytest.mark.slow
def test_the_engines_agree_on_a_panda(batchpid, tmp_path):
    files = "--json", tmp_path / "a.json", "--picture", tmp_path / "a.png"
    status, out, _ = batchpid("parity", "panda", "--moves", "1", "--seconds", "1", "--workers", "0", *files)
    assert status in (0, None)
    assert "simulate the same robot" in out
    assert "moves agree" in out
    figures = json.loads((tmp_path / "a.json").read_text())
    assert figures["bias"] < 2e-6
    assert max(figures["open_loop"]) < 1e-3
    assert max(figures["closed_loop"]) < 1e-3
    assert figures["settled"] == [1, 1]
    assert (tmp_path / "a.png").stat().st_size > 10_000
