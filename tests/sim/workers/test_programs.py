"""Programs with workers: they start without a main guard, from any folder, and no worker remains at
their end.
"""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest
from processes import PATIENCE, have_ended

from batchpid.sim import Runner

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = """
import os, sys
from batchpid.sim import Robot, Runner
robot = Robot.load("panda")
runner = Runner(robot, 8, params=robot.params(), workers=2)
os.write({output}, (" ".join(map(str, runner.pids)) + "\\n").encode())
{body}
"""
LONG = "while True: runner.step(robot.settings.target, substeps=1000000)"
SHORT = "while True: runner.step(robot.settings.target)"
STEP = "os.write({output}, str(runner.step(robot.settings.target).ok.all()).encode())"


def start(body, *arguments, output=1, text=PROGRAM, **options):
    """Start a program with a runner; return its process and the pids of its workers."""
    program = text.format(body=textwrap.dedent(body).format(output=output), output=output)
    paths = [str(ROOT), *filter(None, sys.path)]
    process = subprocess.Popen(
        [sys.executable, *(arguments or ("-W", "ignore")), "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        **options,
    )
    pids = [int(pid) for pid in process.stdout.readline().split()]
    assert len(pids) == 2, process.communicate()[1]
    return process, pids


@pytest.mark.parametrize(
    ("number", "body"),
    [
        (signal.SIGKILL, LONG),
        (signal.SIGINT, LONG),
        pytest.param(signal.SIGTERM, SHORT, marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, SHORT, marks=pytest.mark.slow),
    ],
)
def test_workers_end_with_a_program_that_gets_a_signal(number, body):
    process, pids = start(body)
    with process:
        os.kill(pids[0], signal.SIGSTOP if number == signal.SIGKILL else signal.SIGCONT)
        for _ in range(
            2 if (number, body) == (signal.SIGINT, LONG) else 1
        ):  # a long tick ends with the second one
            time.sleep(0.3)
            process.send_signal(number)
        error = process.communicate(timeout=PATIENCE)[1]
    assert have_ended(pids)
    if number == signal.SIGINT:
        assert error.rstrip().endswith("KeyboardInterrupt")


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ("raise RuntimeError('the caller')", 1),
        ("runner.step(robot.settings.target); del runner; sys.exit(3)", 3),
        pytest.param("os._exit(9)", 9, marks=pytest.mark.slow),
        pytest.param(
            "if os.fork() == 0: runner.close(); os._exit(0)\nos.wait(); " + STEP,
            0,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_workers_end_with_their_runner_or_with_the_program(body, status):
    process, pids = start(body)
    with process:
        output, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == status, error
    assert output == ("True" if STEP in body else "")
    assert have_ended(pids)
    assert "Exception ignored" not in error


CLOSED = "import os\nkept = os.dup(1)\nfor stream in (0, 1, 2): os.close(stream)\n"


@pytest.mark.parametrize(
    ("arguments", "text", "output"),
    [
        (("-W", "error", "-X", "dev"), PROGRAM, 1),
        (("-O",), "import threading\ndef job():\n{job}\nthreading.Thread(target=job).run()", 1),
        (("-I",), "import sys; sys.path.insert(0, " + repr(str(ROOT)) + ")\n" + PROGRAM, 1),
        ((), CLOSED + PROGRAM, 3),
    ],
    ids=["warnings as errors", "a thread", "isolated", "closed streams"],
)
@pytest.mark.slow
def test_programs_run_in_any_way_and_from_any_folder(arguments, text, output, tmp_path):
    for module in ("json.py", "numpy.py"):
        (tmp_path / module).write_text("open('ran-' + __name__, 'w').close()\n")
    text = text.replace("{job}", textwrap.indent(PROGRAM, "    "))
    process, pids = start(STEP, "-P", *arguments, text=text, output=output, cwd=tmp_path)
    with process:
        out, error = process.communicate(timeout=PATIENCE)
    assert out == "True", error
    assert have_ended(pids)
    assert len(list(tmp_path.iterdir())) == 2


def test_workers_outlive_the_thread_that_made_them(panda):
    made = []
    thread = threading.Thread(
        target=lambda: made.append(Runner(panda, 1, params=panda.params(), workers=1))
    )
    thread.start()
    thread.join()
    with made[0] as runner:
        runner.step(panda.start)
        assert runner.recoveries == 0


@pytest.mark.parametrize("workers", [0, 2])
def test_a_closed_runner_keeps_no_descriptor(panda, workers):
    before = len(os.listdir("/proc/self/fd"))
    runner = Runner(panda, 2, workers=workers)
    runner.close()
    assert len(os.listdir("/proc/self/fd")) <= before
