"""batchpid survey: a table, and the same reports as JSON."""

from __future__ import annotations

import json

from tiny_urdf import one_joint, write

KEYS = {
    *("urdf", "dof", "loads", "findings", "moves", "settled"),
    *("worst_error", "worst_overshoot", "seconds", "error"),
}


def test_prints_a_table_and_writes_the_reports(batchpid, tmp_path):
    write(tmp_path, one_joint(), "arm.urdf")
    write(tmp_path, "<robot name='table'><link name='top'/></robot>", "scenery.urdf")
    reports, page = tmp_path / "reports.json", tmp_path / "table.md"
    files = ("--json", reports, "--out", page)
    status, out, _ = batchpid("survey", tmp_path, "--moves", 1, "--seconds", 2.5, "--engine", "mujoco", *files)
    assert status == 0
    assert "1 of 1 files with a moving joint load, 1 get moves, 1 settle on all of them (1 files without" in out
    arm, scenery = json.loads(reports.read_text())
    assert set(arm) == set(scenery) == KEYS
    assert (arm["dof"], arm["loads"], arm["moves"], arm["settled"], arm["error"]) == (1, True, 1, 1, None)
    assert 0 <= arm["worst_error"] < 1e-3
    assert (scenery["dof"], scenery["loads"], scenery["moves"]) == (0, False, 0)
    assert scenery["error"].startswith("reading the description: a robot without joints")
    assert scenery["error"] in out
    assert page.read_text().startswith("| file ")
    assert "| arm.urdf " in page.read_text()
