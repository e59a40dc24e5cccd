"""Gains of operational-space control: tune writes them, and rollout reads them."""

from __future__ import annotations

import shlex

import pytest

import batchpid.task_space as ts

HAND = "panda_hand"


@pytest.mark.slow
def test_tune_writes_gains_that_rollout_reads(batchpid, tmp_path, monkeypatch):
    pytest.importorskip("cmaes")
    for name in ("MOVES", "FINAL_MOVES"):
        monkeypatch.setattr(f"batchpid.sim.tuning.tool_search.{name}", 1)
    out, short = tmp_path / "arm.yaml", ("--search-seconds", 0.1, "--workers", 0, "--physics", "fast")
    flags = ("--control", "osc", "--tool", HAND, "--generations", 1, "--population", 4, "--out", out)
    status, said, error = batchpid("tune", "panda", *short, *flags)
    assert status == 0, error
    assert "as tuned" in said
    assert "Not settled under the gains written" in said  # in so short a time
    assert "WHY: " in said
    assert ts.load_osc_options(out).keys() == {"stiffness", "damping_ratio", "posture_stiffness"}
    assert not out.with_suffix(".search.json").exists()
    command = shlex.split(said.splitlines()[-1].removeprefix("next: "))
    status, said, error = batchpid(*command[1:], "--num-envs", 2, "--workers", 0, "--seconds", 0.02)
    assert status == 0, error
    assert f"Tool: {HAND}" in said


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--tool", HAND), "tool: is for --control osc"),
        (("--control", "osc", "--per-joint"), "per_joint: is not available with --control osc"),
        (("--control", "osc", "--tool", "hand"), "link: unknown link"),
    ],
)
def test_flags_of_the_other_control_are_refused(flags, message, batchpid, tmp_path):
    pytest.importorskip("cmaes")
    status, said, error = batchpid("tune", "panda", *flags, "--out", tmp_path / "a.yaml")
    assert (status, said) == (2, "")
    assert error.startswith(f"batchpid: {message}")
