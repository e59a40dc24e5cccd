"""Survey of robots: each file is loaded, built and moved under designed gains, in a separate process.

A robot that crashes the engine ends only its process, and the survey reports the stage. The moves come from
:func:`batchpid.sim.tuning.moves.random_moves`, the gains from :func:`batchpid.design_gains` per mass matrix.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from batchpid.arrays.array_types import Document
from batchpid.checks.validate import integer, number
from batchpid.errors import BatchPIDError, InvalidArgumentError, RobotError
from batchpid.sim.robot.parts import MOVING_TYPES
from batchpid.sim.robot.urdf import is_mjcf
from batchpid.sim.robot.xml import SIZE_LIMIT, parse_xml
from batchpid.sim.runner_keywords import DEFAULT_ENGINE
from batchpid.sim.workers.worker import ONE_THREAD

STAGES = ("reading the description", "building it in the engine", "checking it", "drawing moves", "moving it")
"""Stages of a survey of one robot, named in :attr:`RobotReport.error`."""
_PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from batchpid.sim.tuning.robot_survey import main; main()"
)


@dataclass(frozen=True)
class RobotReport:
    """Outcome of a survey for one robot; None where a stage was not reached.

    Attributes
    ----------
    urdf
        Path of the file.
    dof
        Number of joints that move, as far as a URDF tells if it does not load.
    loads
        Whether the engine built the robot.
    findings
        Codes of the preflight's findings, repairs included, each once.
    moves, settled
        Number of moves that were drawn, and of those that every joint ended: within 2 % of the move for good, and
        within 1e-3 rad or m of the setpoint over the last tenth of the time.
    worst_error
        Largest such error at the end of a move [rad or m].
    worst_overshoot
        Largest overshoot, as a fraction of the joint's move.
    seconds
        Wall-clock time of the survey of this robot [s].
    error
        One sentence; None for a robot that got through all stages.
    """

    urdf: str
    dof: int | None = None
    loads: bool = False
    findings: tuple[str, ...] = ()
    moves: int = 0
    settled: int = 0
    worst_error: float | None = None
    worst_overshoot: float | None = None
    seconds: float = 0.0
    error: str | None = None

    def asdict(self) -> Document:
        """Return the fields as JSON takes them."""
        return asdict(self) | {"findings": list(self.findings)}


def find_robots(paths: Sequence[Path]) -> list[Path]:
    """Return the files among ``paths``, and the URDF and MJCF files in the folders among them and below, each once.

    A URDF is a file ``*.urdf``, an MJCF file one ``*.xml`` or ``*.mjcf`` with the root ``<mujoco>`` that no other
    includes.

    Raises InvalidArgumentError if a path does not exist, or there is no such file at all.
    """
    found: dict[Path, None] = {}
    for path in paths:
        if path.is_dir():
            found |= dict.fromkeys(_robots_in(path))
        elif path.is_file():
            found[path] = None
        else:
            raise InvalidArgumentError("paths", "must be files or folders", value=str(path), remedy="check the path")
    if not found:
        problem = "hold no file *.urdf and no MJCF file"
        raise InvalidArgumentError("paths", problem, value=", ".join(map(str, paths)), remedy="add one")
    return list(found)


def _robots_in(folder: Path) -> list[Path]:
    """Return the robots' files in a folder and below."""
    files = {each: each.suffix.lower() for each in sorted(folder.rglob("*")) if each.is_file()}
    included = {each: _included(each) for each, suffix in files.items() if suffix in (".xml", ".mjcf")}
    parts = {part for of_file in included.values() for part in of_file or ()}
    is_robot = {each: included.get(each) is not None and each.resolve() not in parts for each in included}
    return [each for each, suffix in files.items() if suffix == ".urdf" or is_robot.get(each, False)]


def _included(path: Path) -> set[Path] | None:
    """Return the files that an MJCF file includes, directly or not; None if the file is no MJCF."""
    try:
        root = parse_xml(path)
    except RobotError:
        return None
    if not is_mjcf(root):
        return None
    files: set[Path] = set()
    pending = [(path, root)]
    for file, element in pending:
        names = [each.get("file", "") for each in element.iter("include")]
        for part in [(folder / name).resolve() for name in names for folder in (path.parent, file.parent)]:
            if part not in files and part.is_file():
                files.add(part)
                with suppress(RobotError):
                    pending.append((part, parse_xml(part)))
    return files


def survey(
    urdfs: Sequence[Path],
    *,
    moves: int = 8,
    seed: int = 0,
    seconds: float = 2.0,
    bandwidth_hz: float = 2.0,
    engine: str = DEFAULT_ENGINE,
    physics: str = "accurate",
    dissipation: str = "urdf",
    package_dirs: Sequence[Path] = (),
    missing_meshes: str = "skip",
    time_limit: float = 300.0,
    processes: int = 1,
) -> Iterator[RobotReport]:
    """Yield a report for each of ``urdfs``, in their order; ``processes`` robots are surveyed at a time.

    Parameters
    ----------
    moves, seed
        Number of moves of each robot, and their seed.
    seconds
        Simulated time of a move [s].
    bandwidth_hz
        Of the designed gains [Hz].
    engine, physics, dissipation, package_dirs, missing_meshes
        Options of :class:`batchpid.sim.Runner` and :meth:`batchpid.sim.Robot.load`.
    time_limit
        Seconds after which the process of a robot is ended [s].

    Raises
    ------
    InvalidArgumentError
        A number out of range.
    """
    number("time_limit", time_limit, 1.0, 1e6, "s")
    options = {
        "moves": integer("moves", moves, 1, 1000),
        "seed": integer("seed", seed, 0, 2**31 - 1),
        "seconds": number("seconds", seconds, 0.05, 600.0, "s"),
        "bandwidth_hz": number("bandwidth_hz", bandwidth_hz, 1e-3, 100.0, "Hz"),
        "engine": engine,
        "physics": physics,
        "loading": {
            "dissipation": dissipation,
            "package_dirs": [str(each) for each in package_dirs],
            "missing_meshes": missing_meshes,
        },
    }
    running: set[subprocess.Popen[str]] = set()
    stop = threading.Event()
    pool = ThreadPoolExecutor(integer("processes", processes, 1, 1024))
    try:
        yield from pool.map(lambda urdf: _in_a_process(urdf, options, time_limit, running, stop), urdfs)
    finally:
        stop.set()
        pool.shutdown(wait=False, cancel_futures=True)
        for child in list(running):
            child.kill()


def _in_a_process(
    urdf: Path,
    options: Document,
    time_limit: float,
    running: set[subprocess.Popen[str]],
    stop: threading.Event,
) -> RobotReport:
    """Return the report on ``urdf``, made in a separate process; a crash of the process is an error of its robot."""
    began, report, stage = time.monotonic(), RobotReport(str(urdf)), STAGES[0]
    child = subprocess.Popen(
        [sys.executable, "-P", "-c", _PROGRAM, json.dumps(sys.path), json.dumps([str(urdf), options])],
        stdin=subprocess.PIPE,  # its end is the parent's
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=os.environ | ONE_THREAD,
    )
    running.add(child)
    if stop.is_set():  # while the process was started
        child.kill()
    timer = threading.Timer(time_limit, child.kill)
    timer.start()
    try:
        assert child.stdout is not None
        for line in child.stdout:
            fields = json.loads(line)
            report = replace(report, **{key: fields[key] for key in fields if key != "stage"})
            stage = fields.get("stage", "surveying it")
        status = child.wait()
    finally:
        timer.cancel()
        child.kill()
        child.communicate()
        running.discard(child)
    if status:
        late = time.monotonic() - began >= time_limit
        ended = f"more than {time_limit:g} s" if late else _exit_text(status)
        report = replace(report, error=f"{stage}: {ended}")
    return replace(report, findings=tuple(report.findings), seconds=round(time.monotonic() - began, 2))


def _exit_text(status: int) -> str:
    return f"the process ended by {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"


def main() -> None:
    """Survey the robot named on the command line; print the report so far as a line of JSON after each stage."""
    urdf, options = json.loads(sys.argv[2])
    out, stage = os.fdopen(os.dup(1), "w"), STAGES[0]
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # SAPIEN prints
    threading.Thread(target=_end_with_the_parent, daemon=True).start()

    def tell(**fields: Any) -> None:
        print(json.dumps({"stage": stage} | fields), file=out, flush=True)

    tell()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for stage, fields in _stages(Path(urdf), **options):  # noqa: B007
                tell(**fields)
    except BatchPIDError as error:
        tell(error=f"{stage}: {str(error).removeprefix(f'{Path(urdf).absolute()}: ')}")
    except Exception as error:
        tell(error=f"{stage}: {type(error).__name__}: {error}")
    out.flush()
    os._exit(0)  # freeing a robot that SAPIEN could not build may crash


def _stages(
    urdf: Path,
    moves: int,
    seed: int,
    seconds: float,
    bandwidth_hz: float,
    engine: str,
    physics: str,
    loading: Document,
) -> Iterator[tuple[str, Document]]:
    """Yield each stage of the survey as it begins, with the fields of the report that the one before found."""
    import batchpid as bp
    from batchpid.sim.robot.robot import Robot
    from batchpid.sim.tuning.evaluation import MAX_ERROR, evaluate_gains
    from batchpid.sim.tuning.moves import random_moves

    yield STAGES[0], {"dof": _count_joints(urdf)}
    robot = Robot.load(urdf, **loading)
    yield STAGES[1], {"dof": robot.dof}
    robot.dynamics()
    yield STAGES[2], {"loads": True}
    findings = robot.check()
    yield STAGES[3], {"findings": list(dict.fromkeys(finding.code for finding in findings))}
    drawn = random_moves(robot, moves, seed)
    yield STAGES[4], {"moves": len(drawn.start)}
    params = bp.design_gains(robot, bandwidth_hz, gain_units="mass_matrix")
    options: Document = {"engine": engine, "physics": physics, "workers": 0}
    metrics = evaluate_gains(robot, params, drawn, seconds=seconds, **options).metrics
    error = np.nan_to_num(metrics.steady_state_error, nan=0.0, posinf=np.inf)
    done = ((error <= MAX_ERROR) & ~np.isinf(metrics.settling_time)).all(1)
    finite = np.isfinite(error).all()
    yield (
        STAGES[4],
        {
            "settled": int(done.sum()),
            "worst_error": float(error.max()) if finite else None,
            "worst_overshoot": float(np.nanmax(metrics.overshoot, initial=0.0)) if finite else None,
            "error": None if finite else f"{STAGES[4]}: it diverged",
        },
    )


def _count_joints(urdf: Path) -> int | None:
    """Return the number of moving joints that a URDF names, readable or not; None if it is no XML, or MJCF."""
    root = etree.fromstring(urdf.read_bytes()[:SIZE_LIMIT], etree.XMLParser(recover=True, resolve_entities=False))
    if root is None or is_mjcf(root):
        return None
    return sum(joint.get("type") in MOVING_TYPES and joint.find("child") is not None for joint in root.iter("joint"))


def _end_with_the_parent() -> None:
    sys.stdin.read()
    os._exit(1)
