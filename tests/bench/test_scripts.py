"""Every script of bench/ runs, on a tiny workload."""

import json
import shutil
from functools import partial

import numpy as np
import pytest
from clusters import FILTERS
from PIL import Image
from robots import load_bundled
from scripts import ROOT, load_script

from batchpid.sim import Robot, Runner, write_recording
from batchpid.sim.view import LiveSimulation

TESTED = {"accuracy", "circles", "cluster", "draw", "film", "measure", "motions", "newcomer"}
TESTED |= {"trajectories", "view"}


def rows(text):
    """Return the cells of the rows of a Markdown table, without its header."""
    lines = [line.strip("| ") for line in text.splitlines() if line.startswith("|")]
    return [line.split(" | ") for line in lines[2:]]


def test_every_script_has_a_test():
    scripts = (path for path in (ROOT / "bench").glob("*.py") if '__name__ == "__main__"' in path.read_text())
    assert {path.stem for path in scripts} == TESTED


def test_accuracy(tmp_path, monkeypatch, capsys):
    accuracy = load_script("accuracy")
    monkeypatch.setattr(Robot, "bundled", lambda: ["panda"])
    accuracy.main(accuracy.Options(count=1, seconds=0.02, json=tmp_path / "new" / "accuracy.json"))
    figures = json.loads((tmp_path / "new" / "accuracy.json").read_text())["accuracy"]
    assert {row["motion"] for row in figures} == {"free", "contact", "limit"}
    assert all(0 < row["rms"] <= row["max"] < 0.1 for row in figures)
    assert "equation of motion" in capsys.readouterr().out


def test_circles(monkeypatch):
    circles = load_script("circles")
    monkeypatch.setattr(circles, "PERIOD", 0.4)
    panda = load_bundled("panda")
    tool, wanted, center = circles.measure(panda, "panda_hand", "sapien", twist=True, acceleration=True)
    assert np.linalg.norm(tool - wanted, axis=1).max() < 0.05
    np.testing.assert_allclose(np.linalg.norm(wanted - center, axis=1), circles.RADIUS)


@pytest.mark.slow
def test_film(tmp_path):
    """Few and short: the gains by hand overshoot, the designed ones do not, and every picture shows robots."""
    film, path = load_script("film"), tmp_path / "new" / "film.gif"
    moves = film.simulate(load_bundled("panda"), 1.0)
    overshoot = [move.qpos[:, :, film.JOINT].max() - film.GOAL[film.JOINT] for move in moves.values()]
    assert overshoot[0] < 0.01
    assert overshoot[1] > 0.3
    film.main(film.Options(path, seconds=0.2, interval=0.1))
    with Image.open(path) as pictures:
        assert pictures.n_frames == 2
        shown = []
        for at in range(2):
            pictures.seek(at)
            shown.append(np.asarray(pictures.convert("L"))[:, :500])
    assert all((picture < 200).mean() > 0.02 for picture in shown)
    assert (shown[0] != shown[1]).any()


def test_film_of_a_recording(tmp_path):
    """Robots with a floating base are drawn where they are: the second picture is of robots that fell."""
    film, path, robot = load_script("film"), tmp_path / "fall.gif", Robot.load("quadruped", fixed_base=False)
    with Runner(robot, 4, params=robot.params(kp=1.0), workers=0, compensate="none") as runner:
        write_recording(runner.rollout(np.tile(robot.start, (31, 1))), tmp_path / "fall.npz")
    film.main(film.Options(path, seconds=0.31, interval=0.3, recording=tmp_path / "fall.npz"))
    with Image.open(path) as pictures:
        heights = []
        for at in range(pictures.n_frames):
            pictures.seek(at)
            heights.append(np.nonzero((np.asarray(pictures.convert("L")) < 100)[50:].any(1))[0].min())
    assert len(heights) == 2
    assert heights[1] > heights[0] + 10


def test_newcomer(tmp_path, capfd):
    """In place of the pages' commands, which take minutes: one that succeeds, one that fails, one without an end."""
    newcomer = load_script("newcomer")
    readme = newcomer.commands(ROOT)
    assert readme[0] == "make demo"
    assert {line.split()[1] for line in readme if line.startswith("batchpid")} >= {"inspect", "tune", "view"}
    missing = "echo \"install it with: pip install 'batchpid[tune]'\" >&2; exit 2"
    for name, does in (("batchpid", f"case $1 in view) sleep 60;; tune) {missing};; esac"), ("pip", "echo $3 > got")):
        script = tmp_path / ".venv" / "bin" / name
        script.parent.mkdir(parents=True, exist_ok=True)
        script.write_text(f"#!/bin/sh\n{does}\n")
        script.chmod(0o755)
    steps = list(newcomer.follow(["batchpid demo", "batchpid tune", "batchpid view"], tmp_path, limit=0.5))
    assert [step.command.split()[1] for step in steps] == ["demo", "tune", "install", "tune", "view"]
    assert [(step.status, step.stopped, step.extra) for step in steps[:2]] == [(0, False, None), (2, False, "tune")]
    assert steps[-1].stopped
    assert (tmp_path / "got").read_text() == ".[tune]\n"
    program, command = newcomer.readme_again(ROOT)
    assert program.startswith("python - <<")
    assert "Runner(" in program
    assert command.startswith("batchpid ")
    assert newcomer.report(newcomer.run(f"exit {status}", tmp_path, None) for status in (0, 1)) == 1


@pytest.mark.slow
def test_measure(tmp_path, capsys):
    measure, path = load_script("measure"), tmp_path / "new" / "panda.json"
    measure.main(measure.Options(num_envs=1, workers=0, ticks=50, rounds=1, json=path))
    figures, out = json.loads(path.read_text()), capsys.readouterr().out
    assert set(figures["rates"]) == set(measure.CASES)
    ours, tutorial = (figures["rates"][case] for case in ("closed loop", "tutorial"))
    assert figures["ratios"]["closed loop"] == 1.0
    assert figures["ratios"]["tutorial"] == pytest.approx(ours / tutorial, abs=2e-3)
    assert figures["per_process"]["tutorial"] == figures["ratios"]["tutorial"]
    assert figures["machine"]["sapien"]
    assert f"{ours / 1e3:.1f}" in out
    assert "passive" in out


def test_motions(tmp_path, monkeypatch, capsys):
    motions = load_script("motions")
    monkeypatch.setattr(motions, "REPEATS", 1)
    path = tmp_path / "motions.json"
    motions.main(motions.Options(("panda",), num_envs=2, moves=1, ticks=5, rounds=1, json=path))
    figures = json.loads(path.read_text())["motions"]
    assert set(figures) == {"panda"}
    assert all(ratio > 0 for robot in figures.values() for variant in robot.values() for ratio in variant.values())
    assert "median" in capsys.readouterr().out


def test_draw(tmp_path):
    """From the figures of the page, as the programs of ``make figures`` write them, comes the page again."""
    docs = tmp_path / "docs"
    (docs / "images").mkdir(parents=True)
    for name in ("docs/performance.md", "docs/performance.json"):
        shutil.copy(ROOT / name, tmp_path / name)
    draw = load_script("draw")
    figures = json.loads((docs / "performance.json").read_text())
    benchmarks = [
        {"group": group, "params": {draw.SCALING[group][0]: int(at)}, "extra_info": {"env_steps_per_second": rate}}
        for group, rates in figures["scaling"].items()
        for at, rate in rates.items()
    ]
    for robot, resources in figures["resources"].items():
        for name, value in resources.items():
            benchmarks.append({"group": "resources", "params": {"workload": robot}, "extra_info": {name: value}})
    new = tmp_path / "new"
    new.mkdir()
    for name, case in figures["cases"].items():
        (new / f"{name}.json").write_text(json.dumps({"machine": figures["machine"]} | case))
    for case, ratios in figures["few"].items():
        for count, ratio in ratios.items():
            params = dict(zip(("name", "physics"), case.split(", "), strict=True), num_envs=int(count))
            benchmarks.append({"group": "few", "params": params, "extra_info": {"over_tutorial": ratio}})
    (new / "pytest.json").write_text(json.dumps({"benchmarks": benchmarks}))
    (new / "motions.json").write_text(json.dumps(figures["motions"]))
    (new / "accuracy.json").write_text(json.dumps({"accuracy": figures["accuracy"]}))
    draw.main(draw.Options(new, docs))
    for name in ("docs/performance.md", "docs/performance.json"):
        assert (tmp_path / name).read_text() == (ROOT / name).read_text(), f"{name}: run bench/draw.py"
    for name in ("performance", "accuracy"):
        assert (docs / "images" / f"{name}.png").stat().st_size > 10_000


class Page:
    """Browser that draws nothing."""

    def get(self, url):
        self.url = url

    def execute_script(self, script):
        return 3 if "return" in script else None

    def quit(self):
        pass


def test_view(monkeypatch, capsys):
    pytest.importorskip("viser")
    pytest.importorskip("selenium")
    view, page = load_script("view"), Page()
    monkeypatch.setattr(view, "open_browser", lambda options, profile: page)
    monkeypatch.setattr(view, "LiveSimulation", partial(LiveSimulation, workers=0))
    view.main(view.Options("panda", num_envs=1, seconds=0.5, loading=0.0, port=18290))
    assert page.url.startswith("http")
    assert "frames/s served" in capsys.readouterr().out


@pytest.mark.slow
class TestOnRay:
    pytestmark = FILTERS

    def test_cluster_and_the_measured_costs_of_the_page_on_large_clusters(self, capsys):
        pytest.importorskip("ray")
        cluster = load_script("cluster")
        bench = cluster.Bench(num_envs=2, workers=1, turns=1, ticks=20, steps=1)
        with cluster.machines(bench.workers) as address:
            bench.run(address)
            assert len(rows(capsys.readouterr().out)) == 3
            assert "round trip" in load_script("scale").measure(calls=2, address=address, ignore_reinit_error=True)


@pytest.mark.parametrize("sines", [False, True])
def test_trajectories(sines, monkeypatch, capsys):
    trajectories = load_script("trajectories")
    monkeypatch.setattr(trajectories, "MOVES", 1)
    monkeypatch.setattr(trajectories, "Runner", partial(Runner, workers=0))
    trajectories.Trajectories(("jaco2",), engine="mujoco", sines=sines).run()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + (4 if sines else 10)
    assert all(line.startswith("jaco2") for line in lines[2:])
