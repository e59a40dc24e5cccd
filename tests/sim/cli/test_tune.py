from __future__ import annotations

import dataclasses
import json

import pytest
from robots import load_bundled

import batchpid as bp
from sim.cli import parse
from sim.tuning.moves import random_moves
from sim.tuning.weights import Weights

pytest.importorskip("cmaes")

SHORT = ("--generations", 1, "--population", 4, "--search-seconds", 0.1, "--workers", 0, "--physics", "fast")


@pytest.fixture(autouse=True)
def few_moves(monkeypatch):
    """Let the final of a search and the table of the commands have two random moves."""
    monkeypatch.setattr("sim.tuning.search.FINAL_MOVES", 2)
    monkeypatch.setattr("sim.cli.run.random_moves", lambda robot, moves, seed: random_moves(robot, min(moves, 2), seed))


def test_tune_writes_params_with_their_settings_and_their_metrics(batchpid, tmp_path):
    out = tmp_path / "panda.yaml"
    status, said, _ = batchpid("tune", "panda", *SHORT, "--out", out)
    assert status == 0
    assert "designed" in said
    assert "tuned" in said
    params, names = bp.load_params(out)
    assert tuple(names) == load_bundled("panda").joint_names
    assert type(params.gain_units).__name__ == "PerMassMatrix"
    about = bp.load_about(out)
    assert about["seed"] == 0
    assert about["judged"]["settling_time"] > 0
    assert {"sapien", "numpy", "cmaes"} <= about["versions"].keys()
    assert out.with_suffix(".png").stat().st_size > 10_000
    assert not out.with_suffix(".search.json").exists()


def test_tune_resumes_a_search_that_was_interrupted(batchpid, tmp_path, monkeypatch):
    out = tmp_path / "a.yaml"

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("sim.cli.run.evaluate_gains", interrupt)  # after the search
        status, _, complaint = batchpid("tune", "panda", *SHORT, "--out", out)
    assert status == 130
    assert "interrupted" in complaint
    history = out.with_suffix(".search.json")
    costs = json.loads(history.read_text())["state"]
    status, _, complaint = batchpid("tune", "panda", *SHORT, "--seed", 1, "--resume", "--out", out)
    assert status == 2
    assert "another search" in complaint
    status, said, _ = batchpid("tune", "panda", *SHORT, "--resume", "--out", out)
    assert status == 0
    assert f"{costs[0][0]:.4f} as designed" in said


def test_designed_gains_are_written_where_the_tuned_ones_are_worse(batchpid, tmp_path, monkeypatch):
    out = tmp_path / "panda.yaml"
    monkeypatch.setattr("sim.tuning.evaluation.Evaluation.worse_than", lambda *_: True)
    status, said, _ = batchpid("tune", "panda", *SHORT, "--out", out)
    assert status == 0
    assert "The designed gains are written" in said
    assert bp.load_about(out)["gains"] == "designed"
    assert (bp.load_params(out)[0].kp == load_bundled("panda").designed().kp).all()


def test_compare_lists_each_set_and_draws_the_first_two(batchpid, tmp_path):
    robot = load_bundled("panda")
    bp.save_params(tmp_path / "mine.yaml", robot.params(kp=1.0, ki=0.0, kd=0.1), robot.joint_names)
    picture = tmp_path / "two.png"
    flags = ("--moves", 1, "--seconds", 1.2, "--workers", 0, "--picture", picture)
    status, said, _ = batchpid("compare", "--gains", "tuned", tmp_path / "mine.yaml", "drive:30,6", *flags)
    assert status == 0
    rows = {line.split("  ")[0]: line for line in said.splitlines() if " of 2" in line}
    assert rows.keys() == {"tuned", "mine.yaml", "drive (30, 6)"}
    assert "2 / 2 of 2" in rows["tuned"]
    assert "never" in rows["mine.yaml"]
    assert picture.stat().st_size > 10_000


def test_each_weight_of_the_search_has_a_flag():
    names = [field.name for field in dataclasses.fields(Weights)]
    flags = [word for index, name in enumerate(names) for word in (f"--{name}", str(index))]
    assert parse(["tune", *flags]).weights == Weights(*range(len(names)))
    assert parse(["tune"]).weights == Weights()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("compare", "--gains", "nothing.yaml"), "neither a name nor a file"),
        (("compare", "--gains", "drive:a,b"), "DAMPING"),
        (("compare", "--gains", "tuned", "--picture", "x.png"), "name two"),
        (("tune", "nobody"), "no robot 'nobody'"),
        (("tune", "panda", "--population", "1"), "population"),
        (("tune", "panda", "--out", "gains.txt"), "gains.txt"),
    ],
)
def test_bad_input_is_an_error_of_status_2(batchpid, tmp_path, monkeypatch, arguments, complaint):
    monkeypatch.chdir(tmp_path)
    status, _, said = batchpid(*arguments)
    assert status == 2
    assert complaint in said
