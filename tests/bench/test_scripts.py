"""The scripts of bench/ run, on a tiny workload."""

import json
import shutil

import pytest
from scripts import ROOT, load_script
from tiny_urdf import one_joint, write


@pytest.mark.slow
def test_measure(tmp_path, capsys):
    measure, path = load_script("measure"), tmp_path / "new" / "panda.json"
    measure.main(measure.Options(num_envs=1, workers=0, ticks=50, rounds=1, json=path))
    figures, out = json.loads(path.read_text()), capsys.readouterr().out
    assert set(figures["rates"]) == set(measure.CASES)
    ours, tutorial = (figures["rates"][case] for case in ("closed loop", "tutorial"))
    assert figures["ratios"]["closed loop"] == 1.0
    assert figures["ratios"]["tutorial"] == pytest.approx(ours / tutorial, abs=2e-3)
    assert figures["machine"]["sapien"]
    assert f"{ours / 1e3:.1f}" in out
    assert "passive" in out


def test_draw(tmp_path):
    """From the figures of the page, as ``make figures`` writes them, comes the page again."""
    docs, new = tmp_path / "docs", tmp_path / "new"
    (docs / "images").mkdir(parents=True)
    new.mkdir()
    shutil.copy(ROOT / "docs/performance.md", docs)
    figures = json.loads((ROOT / "docs/performance.json").read_text())
    for name, case in figures["cases"].items():
        (new / f"{name}.json").write_text(json.dumps({"machine": figures["machine"]} | case))
    draw = load_script("draw")
    draw.main(draw.Options(new, docs))
    assert (docs / "performance.md").read_text() == (ROOT / "docs/performance.md").read_text(), (
        "run bench/draw.py"
    )
    assert json.loads((docs / "performance.json").read_text()) == figures
    assert (docs / "images/performance.png").stat().st_size > 10_000


def test_a_robot_is_surveyed(tmp_path):
    survey, path = load_script("survey"), write(tmp_path, one_joint())
    assert survey.survey(path, "mujoco", 1)[1:3] == ["1", "1 of 1"]
    path.write_text("<robot name='table'><link name='top'/></robot>")
    assert "joints" in survey.survey(path, "mujoco", 1)[-1]
