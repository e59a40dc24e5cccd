"""Everything but SAPIEN's own works with MuJoCo where SAPIEN is not installed, and a run in MuJoCo
never imports it.
"""

import subprocess
import sys

REFUSE = """
import importlib.util
import sys

tried = []


class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "sapien":
            tried.append(name)
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
assert not tried
assert "jax" not in sys.modules
"""
COMMANDS = """
import os
import tempfile

from batchpid.__main__ import main

os.chdir(tempfile.mkdtemp())
for command in (
    "inspect panda",
    "rollout panda --seconds 0.5 --num-envs 2 --workers 0 --out run.h5",
    "compare panda --moves 1",
    "export panda --to mjcf --out panda.xml",
):
    sys.argv = ["batchpid", *command.split()]
    status = main()
    assert status in (0, 3), (command, status)
"""
DEFAULT = """
with Runner(panda, 1, workers=0) as runner:
    assert runner.options.engine == "mujoco"
"""


def test_all_but_sapiens_own_works_without_it():
    """And a run in MuJoCo does not look for it."""
    done = subprocess.run(
        [sys.executable, "-c", REFUSE + RUN + DEFAULT + COMMANDS],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
