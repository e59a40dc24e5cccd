import numpy as np
import pytest
from tiny_urdf import one_joint, write

from batchpid.sim import Robot, Runner, write_recording
from batchpid.sim.cli import main


@pytest.fixture(autouse=True)
def working_folder(tmp_path_factory, monkeypatch):
    """Run each test in an empty folder, so that it neither uses nor adds files of the checkout,
    such as out/.
    """
    monkeypatch.chdir(tmp_path_factory.mktemp("working"))


@pytest.fixture
def batchpid(capsys):
    """Function that runs a command line in this process and returns (exit status, stdout,
    stderr).
    """

    def run(*arguments):
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as exit:  # tyro, for --help and bad flags
            status = exit.code if isinstance(exit.code, int) else 1
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder with a robot and a recording of it."""
    folder = tmp_path_factory.mktemp("files")
    robot = Robot.load(write(folder, one_joint(), "arm.urdf"))
    with Runner(robot, 1, workers=0, substeps=10) as runner:
        rollout = runner.rollout(np.tile(robot.start, (60, 1, 1)))
    write_recording(rollout, folder / "run.h5")
    return folder
