"""Standard streams that are closed, full or piped to a reader that ends; Ctrl-C at any moment."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from processes import PATIENCE
from tiny_urdf import one_joint, write

from batchpid import save_params
from batchpid.sim import Robot
from batchpid.sim.cli import COMMANDS

BATCHPID = f"{sys.executable} -m batchpid"
SHORT = "--num-envs 2 --workers 1 --seconds 0.3"
RUNS = {
    "demo": f"demo {SHORT} --force --picture out/a.png",
    "rollout": f"rollout {SHORT} --force --out out/a.npz --picture out/b.png",
    "tune": "tune arm.urdf --generations 1 --population 4 --seconds 0.05 --workers 1 --force --out out/a.yaml",
    "compare": "compare arm.urdf --moves 1 --workers 1 --seconds 0.3 --force --picture out/a.png",
    "excite": "excite arm.urdf --seconds 1 --force --out out/a.csv",
    "export": "export arm.urdf --force --out out/a.h",
    "identify": "identify arm.urdf log.npz --gains gains.yaml --evaluations 1 --no-payload --workers 0 --force "
    "--out out/a.yaml",
    "inspect": "inspect panda --all",
    "survey": "survey arm.urdf --moves 1 --seconds 0.1 --workers 1 --force --json out/a.json --out out/a.md",
    "plot": "plot run.npz --force",
    "view": "view --num-envs 1 --workers 1 --port 18700 --time-limit 1",
}
"""A short run of each command."""
INPUTS = {"arm.urdf", "gains.yaml", "run.npz", "log.npz"}
WRITTEN = (".yaml", "-tune.png", "-fit.png", ".png", ".npz", ".json", ".md", ".csv", ".h")
MOMENTS = int(os.environ.get("BATCHPID_SOAK_MOMENTS", "4"))
"""Number of interrupts of each command."""


def shell(line: str, folder: Path, status: str = "$?") -> tuple[int, str, str]:
    """Run a command line, and return the ``status`` of bash, stdout and stderr."""
    ran = subprocess.run(["bash", "-c", f"{line}; exit {status}"], capture_output=True, text=True, cwd=folder)
    return ran.returncode, ran.stdout, ran.stderr


@pytest.mark.quick_rows(1)
@pytest.mark.parametrize(
    ("line", "status", "lines"),
    [
        pytest.param("--help >&-", 0, 0, marks=pytest.mark.slow),
        ("--help >/dev/full", 2, 1),
        ("--version <&- >&- 2>&-", 0, 0),
        ("inspect nobody 2>/dev/full", 2, 0),
        pytest.param("inspect nobody 2>&-", 2, 0, marks=pytest.mark.slow),
    ],
)
def test_streams_that_are_closed_or_full(line, status, lines, tmp_path):
    got, out, err = shell(f"{BATCHPID} {line}", tmp_path)
    assert (got, out, err.count("\n")) == (status, "", lines)
    assert not os.listdir(tmp_path)


def test_any_name_can_be_printed_to_any_stdout(tmp_path):
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    ran = subprocess.run([*BATCHPID.split(), "--help"], env=environment, cwd=tmp_path, capture_output=True)
    assert (ran.returncode, ran.stderr) == (0, b"")


def test_ctrl_c_while_packages_are_imported_ends_in_one_line(tmp_path):
    program = "import sys; sys.argv[0] = 'batchpid'; import batchpid, os, signal; os.kill(os.getpid(), signal.SIGINT)"
    ran = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert (ran.returncode, ran.stdout, ran.stderr) == (130, "", "batchpid: interrupted\n")
    program = program.replace("'batchpid'", "'mine'").replace("os.kill", "signal.raise_signal; os.kill")
    ran = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert "KeyboardInterrupt" in ran.stderr  # of another program nothing is changed


@pytest.fixture
def folder(tmp_path):
    """A folder with a recording, a robot, its gains and its log, for long tests of every command."""
    robot = Robot.load(write(tmp_path, one_joint(), "arm.urdf"))
    save_params(tmp_path / "gains.yaml", robot.designed("effort"), robot.joint_names)
    line = f"{BATCHPID} rollout --num-envs 1 --workers 0"
    log = "arm.urdf --gains gains.yaml --seconds 1 --setpoint 0.3 --out log.npz"
    for words in ("--seconds 0.05 --out run.npz", log):
        assert shell(f"{line} {words}", tmp_path)[0] == 0
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_with_streams_that_are_closed_or_full(name, folder):
    ends = {0}
    expected = [(" >&- 2>&- <&-", "$?", ends), (" | head -c 1", "${PIPESTATUS[0]}", ends | {141})]
    expected += [(" > /dev/full", "$?", {2}), (" 2>/dev/full", "$?", ends | {2})]
    for streams, variable, statuses in expected:
        got, _, err = shell(BATCHPID + " " + RUNS[name] + streams, folder, variable)
        assert got in statuses, (streams, got, err)
        assert "Traceback" not in err
        assert not [line for line in err.splitlines() if line.startswith("Exception")]


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_ctrl_c_at_any_moment_of_every_command(name, folder):
    def begin() -> subprocess.Popen:
        words = [*BATCHPID.split(), *RUNS[name].split()]
        return subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder, start_new_session=True
        )

    def wait_for_imports(process: subprocess.Popen) -> None:
        """Wait until batchpid is imported in part: before, Ctrl-C is a matter of Python's."""
        with contextlib.suppress(psutil.Error):
            while process.poll() is None and not any("numpy" in each.path for each in maps(process.pid)):
                time.sleep(0.01)

    def maps(pid: int) -> list:
        return psutil.Process(pid).memory_maps()

    wait_for_imports(process := begin())
    started = time.monotonic()
    _, err = process.communicate()
    assert process.returncode == 0, err
    duration = time.monotonic() - started
    chance, edges = np.random.default_rng(0), np.linspace(0.0, duration, MOMENTS + 1)
    for moment in chance.uniform(edges[:-1], edges[1:]):
        wait_for_imports(process := begin())
        time.sleep(moment)
        if process.poll() is None:
            family = psutil.Process(process.pid).children(recursive=True)
            os.killpg(process.pid, signal.SIGINT)
        else:
            family = []
        _, err = process.communicate(timeout=PATIENCE)
        # -SIGINT: after its end, in that of Python
        assert process.returncode in {0, 130, -signal.SIGINT}, err
        if process.returncode == 130:
            assert err.splitlines()[-1].endswith("batchpid: interrupted")
        assert "Traceback" not in err
        assert "Exception ignored" not in err
        assert not psutil.wait_procs(family, timeout=PATIENCE)[1]
        left = {path.name for path in folder.rglob("*") if path.is_file()}
        assert left <= INPUTS | {"run-responses.png", "b.png", *(f"a{each}" for each in WRITTEN)}
