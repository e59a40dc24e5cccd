import pytest

import batchpid as bp
from batchpid.sim import Robot, Runner, write_recording
from batchpid.sim.identification import excite

PENDULUM = """<robot name="pendulum"><link name="base"/>
<link name="bob"><inertial><origin xyz="0 0 -0.3"/><mass value="2"/>
<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.005"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="bob"/><origin xyz="0 0 0.5"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="40" velocity="6"/></joint></robot>"""


@pytest.fixture
def log(tmp_path):
    """Robot, a recording of it with a motor of 0.9 of its strength, and the params that drove it:
    files.
    """
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    robot = Robot.load(tmp_path / "pendulum.urdf")
    gains, motion = robot.designed("effort"), excite(robot, 1.0, lowest=1.0, rate=200)
    options = {
        "workers": 0,
        "compensate": "gravity",
        "engine": "mujoco",
        "timestep": 0.001,
        "substeps": 5,
    }
    motors = bp.make_actuators(robot.dof, strength=0.9, coulomb=0.5)
    with Runner(robot, 1, params=gains, actuators=motors, **options) as runner:
        runner.reset(motion.position[0])
        rollout = runner.rollout(motion.position)
    bp.save_params(tmp_path / "gains.yaml", gains, robot.joint_names)
    return (
        tmp_path / "pendulum.urdf",
        write_recording(rollout, tmp_path / "run.h5"),
        tmp_path / "gains.yaml",
    )


def test_motors_are_written_for_other_commands(batchpid, log, tmp_path):
    out = tmp_path / "motors.yaml"
    robot, recording, gains = log
    words = ("identify", robot, recording, "--gains", gains, "--no-payload", "--out", out)
    status, said, error = batchpid(*words)
    assert status == 0, error
    assert "hinge" in said
    actuators = Robot.load(robot, actuators=out).actuators
    assert actuators.strength[0, 0] == pytest.approx(0.9, rel=0.1)


def test_a_fit_that_leaves_too_much_of_the_error_ends_in_no_file(
    batchpid, log, tmp_path, monkeypatch
):
    """--force writes the file all the same."""
    monkeypatch.setattr("batchpid.sim.identification.result.EXPLAINS", 0.0)
    robot, recording, gains = log
    out = tmp_path / "motors.yaml"
    words = ("identify", robot, recording, "--gains", gains, "--no-payload", "--out", out)
    status, _, error = batchpid(*words)
    assert status == 2
    assert "are not explained" in error
    assert not out.exists()
    status, _, error = batchpid(*words, "--force")
    assert status == 0, error
    assert out.exists()
