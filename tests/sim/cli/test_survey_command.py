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
    write(tmp_path, "<robot/>", "nothing.urdf")
    reports, page = tmp_path / "reports.json", tmp_path / "table.md"
    status, out, _ = batchpid("survey", tmp_path, "--moves", 1, "--seconds", 2.5, "--json", reports, "--out", page)
    assert status == 0
    assert "1 of 1 files with a moving joint load, 1 get moves, 1 settle on all of them (1 files without" in out
    arm, nothing = json.loads(reports.read_text())
    assert set(arm) == set(nothing) == KEYS
    assert (arm["dof"], arm["settled"], arm["error"]) == (1, 1, None)
    assert nothing["error"] in out
    assert page.read_text().startswith("| file ")
    assert "| arm.urdf " in page.read_text()


def test_no_urdf_at_all(batchpid, tmp_path):
    status, out, err = batchpid("survey", tmp_path)
    assert (status, out) == (2, "")
    assert "hold no file *.urdf" in err
