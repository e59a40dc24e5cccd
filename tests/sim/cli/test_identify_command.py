from __future__ import annotations

import json

import pytest

import batchpid as bp
from sim import Robot, Runner, write_recording
from sim.tuning.identification.excitation import excite

pytest.importorskip("scipy")
pytest.importorskip("cmaes")


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Return a recording of a panda with motors of 0.9 of its strength, and the file of its params."""
    folder, robot = tmp_path_factory.mktemp("log"), Robot.load("panda")
    gains, motion = robot.designed("effort"), excite(robot, seconds=1.0, lowest=1.0, rate=200)
    actuators = bp.make_actuators(robot.dof, strength=0.9)
    options = {"workers": 0, "substeps": 10, "compensate": "gravity+coriolis", "actuators": actuators}
    with Runner(robot, 1, params=gains, **options) as runner:
        runner.reset(motion.position[0])
        rollout = runner.rollout(motion.position)
    bp.save_params(folder / "gains.yaml", gains, robot.joint_names)
    return write_recording(rollout, folder / "run.npz"), folder / "gains.yaml"


def test_motors_are_written_for_other_commands(batchpid, log, tmp_path):
    recording, gains = log
    out, details = tmp_path / "motors.yaml", tmp_path / "motors.json"
    options = ("--evaluations", 1, "--workers", 0, "--no-payload", "--out", out, "--json", details)
    status, said, error = batchpid("identify", "panda", recording, "--params", gains, *options)
    assert status == 0, error
    assert "panda_joint1" in said
    document = json.loads(details.read_text())
    assert set(document["joints"]["panda_joint2"]) == {"armature", "damping", "friction", "strength", "bias"}
    assert document["held_out_error"][1] < document["held_out_error"][0]
    assert Robot.load("panda", actuators=out).actuators is not None
    assert out.with_suffix(".png").exists()
    assert not out.with_suffix(".fit.json").exists()


def test_what_is_missing_is_named(batchpid, log, tmp_path):
    recording, _ = log
    for words, message in (
        (("identify", "panda"), "logs: are missing"),
        (("identify", "panda", recording), "fit its setpoints"),
        (("identify", "panda", recording, "--evaluations", 0), "evaluations"),
    ):
        status, _, error = batchpid(*words, "--out", tmp_path / "motors.yaml")
        assert status != 0
        assert message in error
