from __future__ import annotations

import dataclasses
import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from robots import load_bundled
from tiny_urdf import one_joint, write

import batchpid as bp
import batchpid.task_space as ts
from batchpid.sim import Robot
from batchpid.sim.cli import parse
from batchpid.sim.identification import Region
from batchpid.sim.tuning import Weights, random_moves, tune
from batchpid.sim.tuning.cost import Trial
from batchpid.sim.tuning.evaluation import within

pytest.importorskip("cmaes")

SHORT = ("--generations", 1, "--population", 4, "--seconds", 0.1, "--workers", 0, "--physics", "fast")


@pytest.fixture(autouse=True)
def few_moves(monkeypatch):
    """Use one random move in the final of a search and in the commands' table."""
    monkeypatch.setattr("batchpid.sim.tuning.search.FINAL_MOVES", 1)
    monkeypatch.setattr("batchpid.sim.tuning.search.VARIED_MOVES", 1)
    monkeypatch.setattr(
        "batchpid.sim.cli.run.random_moves", lambda robot, moves, seed: random_moves(robot, min(moves, 1), seed)
    )


@pytest.mark.slow
def test_tune_resumes_an_interrupted_search_and_writes_params_with_settings_and_metrics(
    batchpid, tmp_path, monkeypatch
):
    out = tmp_path / "panda.yaml"

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("batchpid.sim.cli.run.evaluate_gains", interrupt)  # after the search
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
    assert "tuned" in said
    params, names = bp.load_params(out)
    assert tuple(names) == load_bundled("panda").joint_names
    assert type(params.gain_units).__name__ == "PerMassMatrix"
    about = bp.load_about(out)
    assert about["seed"] == 0
    assert about["judged"]["settling_time"] > 0
    assert {"sapien", "numpy", "cmaes"} <= about["versions"].keys()
    assert (tmp_path / "panda-tune.png").stat().st_size > 10_000
    assert not history.exists()


@pytest.mark.usefixtures("undrawn")
def test_tune_within_prints_what_holds_for_all_drawn_motors(batchpid, tmp_path, monkeypatch):
    monkeypatch.setattr("batchpid.sim.cli.tune.DRAWS", 5)
    monkeypatch.setattr("batchpid.sim.cli.tune.MOVES_WITHIN", 1)
    urdf, motors, out = write(tmp_path, one_joint()), tmp_path / "motors.yaml", tmp_path / "tuned.yaml"
    robot = Robot.load(urdf)
    (joint,) = robot.joint_names
    names, ends = (("strength", joint), ("delay", None)), (np.array([0.9, 3e-3]), np.array([0.05, 5e-4]))
    known = Region(names, *ends, np.eye(2)).to_dict()
    late = bp.make_actuators(1, command_delay=3e-3, strength=0.9)
    bp.save_actuators(motors, late, [joint], {"confidence_region": known})
    status, said, _ = batchpid("tune", urdf, *SHORT, "--actuators", motors, "--within", "--out", out)
    assert status == 0
    assert "5 draws of motors" in said
    assert "all are stable at their delay" in said
    assert "binding corner: draw" in said
    within = bp.load_about(out)["within"]
    assert within["draws"] == 5
    assert within["stability_ratio"] < 1
    for arguments, problem in (((), "needs a confidence region"), (("--control", "osc"), "is not available")):
        status, _, complaint = batchpid("tune", urdf, *SHORT, "--within", *arguments, "--out", tmp_path / "other.yaml")
        assert status == 2
        assert problem in complaint


@pytest.mark.usefixtures("undrawn")
def test_the_worst_draw_chooses_among_the_candidates_of_the_search(batchpid, tmp_path, monkeypatch):
    """Here the candidate with the largest kp, which is not the one with the lowest cost."""
    tried = []

    def ranked_by_kp(robot, params, motors, moves, **_):
        tried.append((motors.num_envs, float(params.kp.max())))
        found = within(robot, params, motors, moves, seconds=0.1)
        return found._replace(settling=np.ones(motors.num_envs), excess=np.full(motors.num_envs, 1 / params.kp.max()))

    monkeypatch.setattr("batchpid.sim.cli.tune.DRAWS", 5)
    monkeypatch.setattr("batchpid.sim.tuning.evaluation.within", ranked_by_kp)
    urdf, motors, out = write(tmp_path, one_joint()), tmp_path / "motors.yaml", tmp_path / "tuned.yaml"
    known = Region((("delay", None),), np.array([3e-3]), np.array([5e-4]), np.eye(1)).to_dict()
    bp.save_actuators(
        motors, bp.make_actuators(1, command_delay=3e-3), Robot.load(urdf).joint_names, {"confidence_region": known}
    )
    status, _, complaint = batchpid("tune", urdf, *SHORT, "--actuators", motors, "--within", "--out", out)
    assert status == 0, complaint
    candidates, (draws, kp) = tried[:4], tried[4]
    assert {count for count, _ in candidates} == {2}
    assert (draws, kp) == (5, max(candidates)[1])
    assert kp > candidates[0][1]
    assert bp.load_params(out)[0].kp.max() == pytest.approx(kp)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_designed_gains_are_written_where_the_tuned_ones_are_worse(batchpid, tmp_path, monkeypatch):
    """With settings of the types of their options: text "False" would be true to any program that reads it."""
    urdf, out = write(tmp_path, one_joint(), "arm.urdf"), tmp_path / "gains.yaml"
    monkeypatch.setattr("batchpid.sim.tuning.evaluation.Evaluation.drawback", lambda *_: "chatter: tuned 3, designed 2")
    status, said, error = batchpid("tune", urdf, *SHORT, "--no-collisions", "--out", out)
    assert status == 0, error
    assert "the tuned ones are rejected: chatter: tuned 3, designed 2." in said
    about = bp.load_about(out)
    assert about["gains"] == "designed"
    assert about["rejected"] == "chatter: tuned 3, designed 2"
    assert (bp.load_params(out)[0].kp == Robot.load(urdf).designed().kp).all()
    assert about["collisions"] is False
    assert about["physics"] == "fast"
    assert not [name for name, value in about.items() if value in ("True", "False", "None")]


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_the_last_line_is_a_command_that_works(batchpid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    urdf = write(tmp_path, one_joint(), "my arm.urdf")
    motors = bp.make_actuators(1, command_delay=0.001)
    bp.save_actuators("motors.yaml", motors, Robot.load(urdf).joint_names)
    flags = ("--no-collisions", "--actuators", "motors.yaml", "--randomize", "payload", "--out", "gains.yaml")
    status, said, error = batchpid("tune", "my arm.urdf", *SHORT, *flags)
    assert status == 0, error
    command = shlex.split(said.splitlines()[-1].removeprefix("next: "))
    assert command[:5] == ["batchpid", "rollout", "my arm.urdf", "--gains", "gains.yaml"]
    again = parse(command[1:])
    assert (again.runner.physics, again.runner.collisions, again.randomize) == ("fast", False, "payload")
    assert again.actuators == Path("motors.yaml")
    status, said, error = batchpid(*command[1:], "--num-envs", 1, "--workers", 0, "--seconds", 0.05)
    assert status == 0, error


def test_the_search_says_by_which_figures_it_rejected_its_candidates(tmp_path, monkeypatch):
    robot = Robot.load(write(tmp_path, one_joint()))
    short = {"generations": 1, "seconds": 0.05, "workers": 0, "engine": "mujoco"}
    monkeypatch.setattr(
        "batchpid.sim.tuning.candidates.Candidates.trial",
        lambda self, runner, points: Trial((*points[:, 0] ** 2,), None, None),
    )
    found = tune(robot, population=4, **short)  # the designed gains are at 0
    assert found.rejected.startswith("cost in the search: best candidate 0.")
    assert found.rejected.endswith(", designed 0.0000")

    def worse_in_the_final(self, runner, points):
        return Trial((*points[:, 0] ** 2 * (-1 if len(points) == 5 else 1),), None, None)

    monkeypatch.setattr("batchpid.sim.tuning.candidates.Candidates.trial", worse_in_the_final)
    found = tune(robot, population=5, timestep=0.0005, **short)
    assert found.rejected.startswith("cost in the final: best candidate 0.")
    assert found.rejected.endswith(", designed 0.0000")
    assert found.settings["timestep"] == 0.0005
    np.testing.assert_array_equal(found.params.kp, found.start_params.kp)


@pytest.mark.slow
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
    assert "too slow / too slow" in rows["mine.yaml"]
    assert picture.stat().st_size > 10_000


@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_compare_runs_each_set_in_both_engines(drawn, batchpid, tmp_path, request):
    if not drawn:
        request.getfixturevalue("undrawn")
    pytest.importorskip("mujoco.batch")
    picture = tmp_path / "two.png"
    flags = ("--moves", 1, "--seconds", 0.9, "--workers", 0, "--picture", picture)
    status, said, error = batchpid("compare", "--gains", "tuned", "--engine", "sapien", "mujoco", *flags)
    assert status == 0, error
    rows = {line.split("  ")[0]: line.split()[2:7] for line in said.splitlines() if " of 2" in line}
    assert rows.keys() == {"tuned, SAPIEN", "tuned, MuJoCo"}
    assert "following error" in said
    difference = re.search(r"tuned, SAPIEN / tuned, MuJoCo: (\S+) rad", said)
    assert 0 < float(difference[1]) < 1e-2
    assert max(map(len, said.splitlines())) <= 120
    assert rows["tuned, SAPIEN"] == rows["tuned, MuJoCo"]  # settling times in hundredths of a second
    assert not drawn or picture.stat().st_size > 10_000


def test_each_weight_of_the_search_has_a_flag():
    names = [field.name for field in dataclasses.fields(Weights)]
    flags = [word for index, name in enumerate(names) for word in (f"--{name}", str(index))]
    assert parse(["tune", *flags]).weights == Weights(*range(len(names)))
    assert parse(["tune"]).weights == Weights()


@pytest.mark.slow
def test_tune_writes_gains_of_a_tool_that_rollout_reads(batchpid, tmp_path, monkeypatch):
    for name in ("MOVES", "FINAL_MOVES"):
        monkeypatch.setattr(f"batchpid.sim.tuning.tool_search.{name}", 1)
    out = tmp_path / "arm.yaml"
    flags = ("--control", "osc", "--tool", "panda_hand", "--out", out)
    status, said, error = batchpid("tune", "panda", *SHORT, *flags)
    assert status == 0, error
    assert "as tuned" in said
    assert "Not settled under the gains written" in said  # in so short a time
    assert "WHY: " in said
    assert ts.load_osc_options(out).keys() == {"stiffness", "damping_ratio", "posture_stiffness"}
    assert not out.with_suffix(".search.json").exists()
    command = shlex.split(said.splitlines()[-1].removeprefix("next: "))
    status, said, error = batchpid(*command[1:], "--num-envs", 2, "--workers", 0, "--seconds", 0.02)
    assert status == 0, error
    assert "Tool: panda_hand" in said
