"""Everything but SAPIEN's own works with MuJoCo where SAPIEN is not installed, and a run in MuJoCo never imports it."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytest.importorskip("mujoco.batch")

REFUSE = """
import importlib.util
import sys


class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "sapien":
            raise ModuleNotFoundError("No module named 'sapien'", name="sapien")


sys.meta_path.insert(0, Refuse())
installed = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name == "sapien" else installed(name, package)
"""
RUN = """
import numpy as np

from batchpid.sim import OperationalSpace, Robot, Runner

panda = Robot.load("panda")
panda.check()
panda.designed("effort")
target = panda.settings.target
osc = OperationalSpace(panda, "panda_hand", posture=target)
cases = [({}, target), ({"control": "drive"}, target), ({"collisions": False}, target), ({"workers": 1}, target)]
cases += [({"control": "effort"}, np.zeros(9)), ({"control": osc}, osc.command.neutral)]
for options, setpoint in cases:
    with Runner(panda, 2, **{"workers": 0, "engine": "mujoco", **options}) as runner:
        runner.reset(panda.start)
        seen = runner.rollout(np.tile(setpoint, (5, 1)))
    assert seen.ok.all()
assert "sapien" not in sys.modules
"""
COMMANDS = [
    "inspect panda",
    "rollout panda --seconds 1 --num-envs 2 --workers 0 --out run.npz",
    "compare panda --moves 1 --workers 0 --seconds 0.2",
    "export panda --to mjcf --out panda.xml",
]
COMMAND = """
from batchpid.__main__ import main

sys.argv = ["batchpid", *sys.argv[1:]]
sys.exit(main())
"""


def run(program, *arguments, cwd=None):
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], cwd=cwd, capture_output=True, text=True, timeout=300, check=False
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("installed", [True, False])
def test_a_run_in_mujoco_does_not_import_sapien(installed):
    status, text = run(("import sys\n" if installed else REFUSE) + RUN)
    assert status == 0, text
    assert "SAPIEN is not installed" not in text  # the engine was named


def test_the_default_engine_is_told():
    program = """
from batchpid.sim import Robot, Runner
with Runner(Robot.load("panda"), 1, workers=0) as runner:
    assert runner.options.engine == "mujoco"
"""
    status, text = run(REFUSE + program)
    assert status == 0, text
    assert text.count("SAPIEN is not installed: the engine is 'mujoco'") == 1


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_runs_without_sapien(command, tmp_path):
    status, text = run(REFUSE + COMMAND, *command.split(), cwd=tmp_path)
    assert status in (0, 3), text
    assert "Traceback" not in text
