import re
from pathlib import Path

import pytest
from tiny_urdf import one_joint, write

import batchpid as bp
from batchpid.io import documents
from batchpid.sim import Robot
from batchpid.sim.tuning.moves import seeded_moves

pytest.importorskip("cmaes")


@pytest.fixture(autouse=True)
def few_moves(monkeypatch):
    """Use one random move in the final of a search and in the commands' table."""
    monkeypatch.setattr("batchpid.sim.tuning.search.FINAL_MOVES", 1)
    monkeypatch.setattr("batchpid.sim.tuning.search.SEARCH_MOVES", 1)
    monkeypatch.setattr(
        "batchpid.sim.tuning.evaluation.seeded_moves",
        lambda robot, moves, seed: seeded_moves(robot, min(moves, 1), seed),
    )


@pytest.mark.slow
def test_tune_writes_the_better_gains_with_settings(batchpid, tmp_path, monkeypatch):
    """Settings have the types of their options: text "False" would be true to any program that
    reads it.
    """
    monkeypatch.chdir(tmp_path)
    robot = Robot.load(write(tmp_path, one_joint(), "my arm.urdf"))
    Path("payload.yaml").write_text("payload: {uniform: [0, 0.5]}")
    bp.save_actuators("motors.yaml", bp.make_actuators(1, command_delay=0.001), robot.joint_names)
    flags = (
        "--actuators",
        "motors.yaml",
        "--randomize",
        "payload.yaml",
        "--out",
        "gains.yaml",
        "--picture",
        "tune.png",
    )
    status, said, error = batchpid("tune", "my arm.urdf", "--generations", 1, *flags)
    assert status == 0, error
    about = documents.read("gains.yaml")["about"]
    assert (about["seed"], about["engine"]) == (0, "mujoco")
    assert about["gains"] == ("designed" if "rejected" in about else "tuned")
    assert ("The designed gains are the result" in said) == ("rejected" in about)
    assert "gains at the start pose" in said
    assert not [name for name, value in about.items() if value in ("True", "False", "None")]
    assert (tmp_path / "tune.png").stat().st_size > 5_000


@pytest.mark.parametrize("drawn", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_compare_runs_each_set_in_both_engines(drawn, batchpid, tmp_path, request):
    if not drawn:
        request.getfixturevalue("undrawn")
    picture = tmp_path / "two.png"
    flags = ("--moves", 1, "--picture", picture)
    status, said, error = batchpid(
        "compare", "--gains", "tuned", "--engine", "sapien", "mujoco", *flags
    )
    assert status == 0, error
    rows = {line.split("  ")[0]: line.split()[2:7] for line in said.splitlines() if " of 2" in line}
    assert rows.keys() == {"tuned, SAPIEN", "tuned, MuJoCo"}
    assert "following error" in said
    difference = re.search(r"tuned, SAPIEN / tuned, MuJoCo: (\S+) rad", said)
    assert 0 < float(difference[1]) < 1e-2
    assert max(map(len, said.splitlines())) <= 120
    assert (
        rows["tuned, SAPIEN"] == rows["tuned, MuJoCo"]
    )  # settling times in hundredths of a second
    assert not drawn or picture.stat().st_size > 10_000
