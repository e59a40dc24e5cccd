"""Every example runs with the flags of its docstring, and its results support its claims."""

import importlib.util
import os
import re
import runpy
import shlex
import sys
from functools import partial
from pathlib import Path

import pytest
from robots import load_bundled

import batchpid as bp
import batchpid.sim
from batchpid.sim import Runner, read_recording
from batchpid.sim.cli import main

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture
def run(monkeypatch, capsys):
    monkeypatch.syspath_prepend(EXAMPLES)  # as Python does for a script: examples share a module

    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.fixture
def one_process(monkeypatch):
    """Let runners run in this process unless told otherwise: the results are the same."""
    monkeypatch.setattr(batchpid.sim, "Runner", partial(Runner, workers=0))


def errors(table):
    """Joint -> error of env 0, from the table of drive_robot.py."""
    return {row.split()[0]: float(row.split()[4]) for row in table.splitlines()[2:]}


def test_every_example_is_tested():
    tested = set(re.findall(r'"(\w+\.py)"', Path(__file__).read_text()))
    tested.add("ppo.py")  # both trainings import it
    assert {path.name for path in EXAMPLES.glob("*.py")} <= tested


@pytest.mark.usefixtures("one_process")
def test_an_undriven_robot_falls_and_the_pid_reaches_the_target(run):
    panda = ("drive_robot.py", "panda", "--num-envs", "2")
    rows = [row.split() for row in run(*panda, "--seconds", "1").splitlines()[2:]]
    assert max(abs(float(end) - float(start)) for _, start, _, end, *_ in rows) > 0.5
    held = errors(run(*panda, "--seconds", "1.2", "--use-external-pid"))
    assert max(held.values()) < 2e-3


def test_drive_and_pid_together_are_an_error(run):
    with pytest.raises(SystemExit, match="choose one"):
        run("drive_robot.py", "--use-internal-drive", "--use-external-pid")


def test_the_boxes_of_hello_world_fall_to_the_ground(run):
    rows = [
        line.split()
        for line in run("hello_world.py").splitlines()
        if re.match(r" +\d\.\d\d ", line)
    ]
    first, last = ([float(z) for z in row[1:]] for row in (rows[0], rows[-1]))
    assert first == pytest.approx([0.5, 0.6, 0.7, 0.8])
    assert last == pytest.approx([0, 0, 0, 0], abs=5e-3)


def test_the_engines_move_alike(run):
    pytest.importorskip("sapien")
    text = run("two_engines.py")
    assert "times as fast" in text
    assert float(text.split()[-2]) < 1e-3


@pytest.mark.slow
@pytest.mark.usefixtures("one_process")
def test_a_profile_is_followed_with_less_error_than_a_step(run):
    text = run("follow_trajectory.py")
    worst = {
        row[:14].strip(): float(row[14:].split()[2]) for row in text.splitlines() if " mrad " in row
    }
    assert set(worst) >= {"half as fast", "minimum jerk", "step"}
    assert max(worst["minimum jerk"], worst["half as fast"]) < 1 < 500 < worst["step"]  # mrad


@pytest.mark.slow
def test_the_integral_removes_the_error_of_an_uncompensated_drive(run, tmp_path):
    picture = tmp_path / "errors.png"
    text = run("steady_state.py", "--seconds", "3", "--picture", str(picture))
    errors = {
        row[:32].strip(): [float(e) for e in row[32:].split()]
        for row in text.splitlines()
        if "compensat" in row
    }
    assert max(errors["drive (20, 5), no compensation"]) > 0.3
    assert max(errors["PID, no compensation"]) < 2e-3
    assert max(errors["PID, compensated"]) < 1e-3
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["torque", "servo", "velocity"])
def test_the_motor_of_each_kind_of_controller_is_identified(run, tmp_path, kind):
    (line,) = [
        each
        for each in run("real_logs.py", "--out", str(tmp_path)).splitlines()
        if f"{kind}." in each
    ]
    words = [*shlex.split(line)[1:], "--out", str(tmp_path / "motors.yaml")]
    assert not main(words)
    module = runpy.run_path(str(EXAMPLES / "real_logs.py"))
    found = bp.load_actuators(tmp_path / "motors.yaml", ("hinge",))[0]
    for name, value, near in (
        ("strength", module["STRENGTH"][kind], 0.01),
        *((name, value, 0.03) for name, value in module["MOTOR"].items()),
    ):
        # Measured efforts show neither the delay of commands nor the motor's strength.
        if kind != "velocity" or name not in ("command_delay", "strength"):
            assert getattr(found, name)[0, 0] == pytest.approx(value, rel=near)


def test_the_gait_of_the_quadruped_walks(run):
    distances = [
        float(number) for number in re.findall(r"\d\.\d+", run("walk.py").partition("walked")[2])
    ]
    assert len(distances) == 4
    assert min(distances) > 0.1


def test_a_tool_reaches_its_goals_and_pushes_a_box(run):
    assert "4 of 4 hands are at their goals" in run("tool_reach.py")
    moved = [float(number) for number in re.findall(r"0\.\d+", run("push.py"))]
    assert len(moved) == 2
    assert min(moved) > 0.02


@pytest.mark.parametrize("flags", [(), ("--no-motors", "--delay", "0.03")])
def test_a_plan_is_followed(run, flags):
    small = ("--samples", "8", "--seconds", "0.2", "--workers", "0")
    assert re.search(r"goes around: least distance \d+ mm", run("plan_reach.py", *small, *flags))


@pytest.mark.slow
def test_plans_keep_away_from_the_ball_if_the_rollouts_have_the_motors(run):
    distances = []
    for flags in ((), ("--no-motors",)):
        text = run("plan_reach.py", "--delay", "0.03", *flags)
        distances.append(int(re.search(r"least distance (-?\d+) mm", text)[1]))
    # By 60 mm; the search takes another path on another processor.
    assert distances[0] > distances[1] + 20


@pytest.mark.slow
def test_stable_baselines3_trains(run):
    pytest.importorskip("stable_baselines3")
    assert "trained for 128 steps" in run("stable_baselines.py")


needs_training = pytest.mark.skipif(importlib.util.find_spec("optax") is None, reason="needs Optax")
SMALL = (
    "--num-envs",
    "4",
    "--workers",
    "0",
    "--episode",
    "5",
    "--steps",
    "8",
    "--updates",
    "2",
    "--minibatches",
    "2",
)


@needs_training
@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
@pytest.mark.parametrize("way", [(), ("--chunk", "2", "--latency", "0.0", "0.02")])
def test_a_short_training_ends_with_a_picture(run, tmp_path, way):
    picture = tmp_path / "curve.png"
    policy = str(tmp_path / "policy.npz")
    files = ("--picture", str(picture), "--out", policy)
    text = run("train_reach.py", *SMALL, *way, "--epochs", "1", *files)
    assert "of 4 episodes end at the goal" in text
    assert picture.stat().st_size > 10_000
    # The file holds the policy: it does the same once more, without a training.
    again = run("train_reach.py", *SMALL, *way, "--policy", policy)
    assert again.splitlines()[-1] == text.splitlines()[-2]


@needs_training
@pytest.mark.slow
@pytest.mark.usefixtures("quick_compilation")
def test_a_short_training_to_walk_ends_with_a_picture_and_a_recording(run, tmp_path):
    files = ("--picture", str(tmp_path / "curve.png"), "--record", str(tmp_path / "walk.h5"))
    text = run(
        "train_walk.py", *SMALL, "--epochs", "1", "--time", "0.2", "--evaluated", "4", *files
    )
    assert "of 4 robots walk for 0.2 s" in text
    assert (tmp_path / "curve.png").stat().st_size > 10_000
    assert read_recording(tmp_path / "walk.h5").base_pose.shape == (10, 4, 7)


@needs_training
@pytest.mark.slow
def test_the_trained_quadruped_walks(run):
    share = re.search(r"exploration ([\d.]+)% of 32 robots walk for 10 s", run("train_walk.py"))
    assert share is not None
    assert float(share[1]) >= 95


@needs_training
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(int(os.environ.get("BATCHPID_SOAK_SEEDS", "1"))))
def test_the_trained_policy_reaches_nine_goals_of_ten(run, seed):
    share = re.search(r"exploration ([\d.]+)% of 64", run("train_reach.py", "--seed", str(seed)))
    assert share is not None
    assert float(share[1]) >= 90


@pytest.mark.slow
def test_a_log_of_mujoco_is_written_with_the_params_that_drove_it(run, tmp_path):
    said = run("mujoco_log.py", "panda", "--seconds", "1", "--out", str(tmp_path / "log.csv"))
    header = (tmp_path / "log.csv").read_text().partition("\n")[0].split(",")
    assert header[0] == "time"
    assert {name.partition(":")[0] for name in header[1:]} == {"setpoint", "qpos"}
    assert (tmp_path / "log.params.yaml").is_file()
    truth, names = bp.load_actuators(tmp_path / "log.truth.yaml")
    row = next(line for line in said.splitlines() if line.startswith(names[0])).split()
    written = truth.armature, truth.viscous + load_bundled("panda").damping, truth.coulomb
    assert [float(value) for value in row[1:4]] == pytest.approx(
        [leaf[0, 0] for leaf in written], rel=1e-3
    )
    assert f"delay of the commands: {1e3 * truth.command_delay[0, 0]:.4g} ms" in said


NOTEBOOKS = sorted(EXAMPLES.glob("*.ipynb"))


def shown(notebook):
    """Return the formats of all outputs of a notebook, in order."""
    return [
        sorted(output.get("data", {}))
        for cell in notebook.cells
        for output in cell.get("outputs", [])
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_is_stored_with_its_pictures_and_without_paths_of_a_machine(path):
    notebook = pytest.importorskip("nbformat").read(path, as_version=4)
    formats = [kind for output in shown(notebook) for kind in output]
    assert formats.count("image/png") == 3
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == [*range(1, len(counts) + 1)], "run all cells before it is stored"
    assert not re.search(r"[\"'> ]/(home|root|tmp|usr|work|Users)/", path.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.name)
def test_a_notebook_runs_and_shows_what_is_stored(path):
    client = pytest.importorskip("nbclient")
    formats = pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook = formats.read(path, as_version=4)
    stored = shown(notebook)
    for cell in notebook.cells:
        cell.source = cell.source.replace("(8, robot.dof)", "(2, robot.dof)").replace(
            "num_envs=8", "num_envs=2"
        )
    notebook.cells.append(
        formats.v4.new_code_cell("assert np.abs(good.qpos[-1] - goal).max() < 1e-3")
    )
    client.NotebookClient(
        notebook, timeout=120, resources={"metadata": {"path": str(path.parent)}}
    ).execute()
    assert shown(notebook) == stored


@pytest.mark.usefixtures("one_process")
def test_an_aligned_plan_is_near_and_smooth(run):
    lines = run("slow_policy.py", "--seconds", "2.5", "--num-envs", "2").splitlines()[2:]
    cells = [line.split("|")[1:-1] for line in lines]
    figures = {row[0].strip(): [float(cell) for cell in row[1:]] for row in cells}
    error, acceleration, change = figures["cubic, aligned"]
    assert error <= 2 < figures["linear"][0] < figures["held"][0]
    assert acceleration <= 10
    assert change <= 4 < figures["cubic"][2]


@pytest.mark.slow
@pytest.mark.usefixtures("one_process")
def test_gains_by_gradient_beat_the_designed_ones(run):
    lines = run("gradient_gains.py", "--moves", "2", "--generations", "1").splitlines()
    losses = {name: float(value) for name, value, _ in map(str.split, lines)}
    assert losses["gradient"] < 0.8 * losses["designed"]


@pytest.mark.usefixtures("one_process")
def test_chunks_that_have_a_file_are_not_run_again(run, tmp_path):
    flags = (
        "many_gains.py",
        "--num-envs",
        "3",
        "--chunk",
        "2",
        "--seconds",
        "0.05",
        "--folder",
        str(tmp_path),
    )
    said = run(*flags)
    first = (tmp_path / "0.h5").stat().st_mtime_ns
    (tmp_path / "2.h5").unlink()
    assert run(*flags) == said
    assert (tmp_path / "0.h5").stat().st_mtime_ns == first
    assert [read_recording(tmp_path / name).num_envs for name in ("0.h5", "2.h5")] == [2, 1]
