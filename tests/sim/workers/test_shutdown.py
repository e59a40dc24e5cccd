"""No worker process and no shared memory remains when a program ends, for any cause."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import pytest
from processes import PATIENCE, have_ended, shared_memory

from batchpid.sim import Runner

PROGRAM = """
import sys, numpy as np, warnings
warnings.simplefilter("ignore")
from batchpid.sim import Robot, Runner
robot = Robot.load("panda")
runner = Runner(robot, 8, params=robot.params(), workers={workers})
print(*runner.pids, flush=True)
{body}
"""


def start(body, workers=2, **options):
    """Start a program with a runner; return its process and the pids of its workers."""
    text = PROGRAM.format(body=textwrap.dedent(body), workers=workers)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))}
    process = subprocess.Popen(
        [sys.executable, "-c", text],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        **options,
    )
    pids = [int(pid) for pid in process.stdout.readline().split()]
    assert len(pids) == workers, process.communicate()[1]
    return process, pids


LONG = "while True: runner.step(robot.settings.target, substeps=1000000)"
SHORT = "while True: runner.step(robot.settings.target)"
ENDS: list = [(signal.SIGKILL, LONG)]
MORE_ENDS = [
    (signal.SIGINT, LONG),
    (signal.SIGTERM, LONG),
    (signal.SIGSEGV, LONG),
    (signal.SIGKILL, SHORT),
    (signal.SIGINT, SHORT),
]
ENDS += [pytest.param(*end, marks=pytest.mark.slow) for end in MORE_ENDS]


@pytest.mark.parametrize(("number", "body"), ENDS)
def test_workers_end_with_a_parent_that_gets_a_signal(number, body):
    shared = shared_memory()
    process, pids = start(body)
    with process:
        time.sleep(0.3)
        process.send_signal(number)
        if (number, body) == (signal.SIGINT, LONG):  # a tick of many minutes ends with the second one
            time.sleep(0.3)
            process.send_signal(number)
        error = process.communicate(timeout=PATIENCE)[1]
    assert have_ended(pids)
    assert shared_memory() <= shared
    if number == signal.SIGINT:
        assert error.rstrip().endswith("KeyboardInterrupt")


@pytest.mark.slow
def test_stopped_workers_end_with_a_parent_that_is_killed():
    process, pids = start(SHORT)
    with process:
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        process.kill()
        process.communicate(timeout=PATIENCE)
    assert have_ended(pids)


def test_workers_outlive_the_thread_that_made_them(panda):
    made = []
    thread = threading.Thread(target=lambda: made.append(Runner(panda, 1, params=panda.params(), workers=1)))
    thread.start()
    thread.join()
    with made[0] as runner:
        pids = runner.pids
        runner.step(panda.start)
        assert (runner.pids, runner.recoveries) == (pids, 0)


@pytest.mark.parametrize(
    ("body", "status"),
    [
        pytest.param("raise RuntimeError('the caller')", 1, marks=pytest.mark.slow),
        pytest.param("sys.exit(7)", 7, marks=pytest.mark.slow),  # the interpreter ends as with an error
        pytest.param("runner.close(); runner.close(); sys.exit(3)", 3, marks=pytest.mark.slow),
        pytest.param("import os; os._exit(9)", 9, marks=pytest.mark.slow),
        ("runner.step(robot.settings.target); del runner; print('end')", 0),
        pytest.param("f = Runner.__exit__; f(runner, None, None, None)", 0, marks=pytest.mark.slow),
    ],
)
def test_workers_end_with_their_runner_or_with_the_program(body, status):
    process, pids = start(body, workers=1)
    with process:
        error = process.communicate(timeout=PATIENCE)[1]
    assert process.returncode == status, error
    assert have_ended(pids)
    assert "Exception ignored" not in error


@pytest.mark.slow
def test_a_forked_child_does_not_end_the_workers_of_its_parent():
    body = """
    import os
    child = os.fork()
    if child == 0:
        runner.close()
        os._exit(0)
    os.waitpid(child, 0)
    print(runner.step(robot.settings.target).ok.all())
    """
    process, pids = start(body, workers=1)
    with process:
        output, error = process.communicate(timeout=PATIENCE)
    assert output.strip() == "True", error
    assert have_ended(pids)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["stdin", "script", "thread"])
def test_programs_need_no_main_guard(kind, tmp_path):
    text = PROGRAM.format(body="print(runner.step(robot.settings.target).ok.all(), len(runner.pids))", workers=1)
    if kind == "thread":
        text = "import threading\ndef job():\n" + textwrap.indent(text, "    ")
        text += "\nthread = threading.Thread(target=job); thread.start(); thread.join()"
    script = tmp_path / "script.py"
    script.write_text(text)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), *sys.path]))}
    arguments = [sys.executable, "-"] if kind == "stdin" else [sys.executable, str(script)]
    done = subprocess.run(
        arguments,
        input=text if kind == "stdin" else None,
        capture_output=True,
        text=True,
        env=environment,
        cwd=tmp_path,
        timeout=PATIENCE,
    )
    assert done.stdout.splitlines()[-1] == "True 1", done.stderr
    assert have_ended([int(pid) for pid in done.stdout.splitlines()[0].split()])


def test_a_closed_runner_keeps_no_pipe_or_socket_of_its_workers(panda):
    def pipes_and_sockets():
        links = (os.readlink(path) for path in Path("/proc/self/fd").iterdir() if path.is_symlink())
        return sorted(link for link in links if link.startswith(("pipe:", "socket:")))

    Runner(panda, 2, workers=2).close()  # starts what stays, such as the server that forks workers
    gc.collect()
    before = pipes_and_sockets()
    gc.disable()
    try:
        runner = Runner(panda, 2, workers=2)
        assert pipes_and_sockets() != before
        runner.close()
        assert pipes_and_sockets() == before
    finally:
        gc.enable()
