"""The working folder of a program, which may hold a stranger's files, is not on the import path of its workers."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
from batchpid.sim import Robot, Runner
robot = Robot.load("panda")
with Runner(robot, 1, workers=1) as runner:
    print(runner.step(robot.start).ok)
"""


@pytest.mark.slow
def test_workers_do_not_run_modules_of_the_working_folder(tmp_path):
    modules = {"json.py", "sim.py", "numpy.py"}
    for module in modules:
        (tmp_path / module).write_text("open('ran-' + __name__, 'w').close()\n")
    program = [sys.executable, "-P", "-W", "ignore", "-c", PROGRAM]
    said = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=True)
    assert said.stdout == "[ True]\n"
    assert {path.name for path in tmp_path.iterdir()} == modules
