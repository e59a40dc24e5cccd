from __future__ import annotations

import json
import re

import numpy as np
import pytest
import yaml
from tqdm import tqdm

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Runner, write_recording
from batchpid.sim.identification import excite

pytest.importorskip("scipy")
pytest.importorskip("cmaes")

pytestmark = pytest.mark.filterwarnings("ignore::batchpid.sim.MovingSetpointWarning")

PENDULUM = """<robot name="pendulum"><link name="base"/>
<link name="bob"><inertial><origin xyz="0 0 -0.3"/><mass value="2"/>
<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.005"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="bob"/><origin xyz="0 0 0.5"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="40" velocity="6"/></joint></robot>"""


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return make_log(tmp_path_factory.mktemp("log"))


def make_log(folder, engine="sapien"):
    """Robot, a recording of it with a motor of 0.9 of its strength, and the params that drove it: files."""
    (folder / "pendulum.urdf").write_text(PENDULUM)
    robot = Robot.load(folder / "pendulum.urdf")
    gains, motion = robot.designed("effort"), excite(robot, 1.0, lowest=1.0, rate=200)
    actuators = bp.make_actuators(robot.dof, strength=0.9)
    options = {"workers": 0, "substeps": 10, "compensate": "gravity+coriolis", "actuators": actuators, "engine": engine}
    with Runner(robot, 1, params=gains, **options) as runner:
        runner.reset(motion.position[0])
        rollout = runner.rollout(motion.position)
    bp.save_params(folder / "gains.yaml", gains, robot.joint_names)
    return folder / "pendulum.urdf", write_recording(rollout, folder / "run.npz"), folder / "gains.yaml"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("engine", "evaluations"),
    [("sapien", 1), *(pytest.param(engine, 4, marks=pytest.mark.slow) for engine in ("sapien", "mujoco"))],
)
def test_motors_are_written_for_other_commands(batchpid, tmp_path, monkeypatch, engine, evaluations):
    """From the motion in either engine, whose model the fit shares; the progress gives the longest time to go, since a
    fit mostly ends long before its last evaluation. With one evaluation the search has few steps, too.
    """
    pytest.importorskip("mujoco.batch" if engine == "mujoco" else "sapien")
    if evaluations == 1:
        monkeypatch.setattr("batchpid.sim.identification.fit_search.hypotheses", lambda drive, payload: [drive])
        monkeypatch.setattr("batchpid.sim.identification.fit_search.GENERATIONS", 1)
        monkeypatch.setattr("batchpid.sim.identification.fit_search.NEIGHBOUR_EVALUATIONS", 2)
    bars = []
    monkeypatch.setattr(
        "batchpid.sim.cli.identify.bar", lambda label, **options: bars.append((label, options)) or (lambda x: x)
    )
    robot, recording, gains = make_log(tmp_path, engine)
    out, details = tmp_path / "motors.yaml", tmp_path / "motors.json"
    options = ("--evaluations", evaluations, "--workers", 0, "--no-payload", "--out", out, "--json", details)
    status, said, error = batchpid("identify", robot, recording, "--gains", gains, *options)
    assert status == 0, error
    assert "hinge" in said
    document = json.loads(details.read_text())
    assert set(document["joints"]["hinge"]) == {"armature", "damping", "friction", "strength", "bias"}
    assert document["held_out_error"][1] < document["held_out_error"][0] / (10 if evaluations > 1 else 1)
    assert Robot.load(robot, actuators=out).actuators is not None
    assert (tmp_path / "motors-fit.png").exists()
    assert not out.with_suffix(".fit.json").exists()
    ((label, options),) = bars
    shown = tqdm.format_meter(8, 91, 63.0, prefix=label, postfix="error=0.1", **options)
    assert shown == "identifying: 8 of at most 91 evaluations, 01:03, at most 10:53 more, error=0.1"


def effort_log(path, wrong=0.0):
    """Write a log of efforts, made by the equations of a hinge; on its first rows ``wrong`` (a share) has their sign
    reversed.
    """
    inertia, damping, dt, count = 0.03 + 2 * 0.3**2 + 0.02, 0.1, 1e-3, 1000
    time = dt * np.arange(count)
    effort = 3.0 * np.sin(2 * np.pi * (1.0 + 1.5 * time) * time)
    qpos, q, v = np.empty(count), 0.1, 0.0
    for step in range(count):
        qpos[step] = q
        v = (inertia * v + dt * (0.9 * effort[step] + 9.81 * 2 * 0.3 * np.sin(np.pi + q))) / (inertia + dt * damping)
        q += dt * v
    qpos += 1e-5 * np.random.default_rng(0).standard_normal(count)
    logged = np.where(np.arange(count) < wrong * count, -effort, effort)
    rows = [f"{a:.9g},{b:.12g},{c:.12g}" for a, b, c in zip(time, logged, qpos, strict=True)]
    path.write_text("\n".join(["time,effort:hinge,qpos:hinge", *rows]))
    return path


@pytest.fixture
def short_search(monkeypatch):
    """The search has few steps: one generation, short fits of neighbours."""
    monkeypatch.setattr("batchpid.sim.identification.fit_search.GENERATIONS", 1)
    monkeypatch.setattr("batchpid.sim.identification.fit_search.NEIGHBOUR_EVALUATIONS", 1)


ERROR = re.compile(r"position error on the part that was kept: (\S+) as described, (\S+) by the values of the file")


@pytest.mark.usefixtures("short_search")
def test_a_motion_that_is_explained_ends_in_a_file_whose_error_is_printed(batchpid, tmp_path):
    """The printed error is that of the file: printed again for the file alone, it is the same; and it depends on the
    file's values, of other programs' files too.
    """
    (robot := tmp_path / "pendulum.urdf").write_text(PENDULUM)
    log, out = effort_log(tmp_path / "log.csv"), tmp_path / "motors.yaml"
    common = ("identify", robot, log, "--compensate", "none", "--timestep", 1e-3, "--evaluations")
    status, said, error = batchpid(*common, 3, "--workers", 0, "--no-payload", "--out", out)
    assert status == 0, error
    before, after = ERROR.search(said).groups()
    assert float(after) < 0.1 * float(before)
    judge = (*common, 0, "--actuators", out)
    status, said, error = batchpid(*judge)
    assert status == 0, error
    assert ERROR.search(said).groups() == (before, after)
    document = yaml.safe_load(out.read_text())
    del document["about"]  # as if by other programs: neither noise nor stopping time is known
    out.write_text(yaml.safe_dump(document))
    _, said, _ = batchpid(*judge)
    assert float(ERROR.search(said)[2]) == pytest.approx(float(after), rel=0.5)
    document["joints"]["hinge"]["strength"] *= 0.8
    out.write_text(yaml.safe_dump(document))
    _, said, _ = batchpid(*judge)
    assert float(ERROR.search(said)[2]) > 5 * float(after)
    document["joints"]["hinge"] = {"backlash": 0.01}
    out.write_text(yaml.safe_dump(document))
    status, _, error = batchpid(*judge)
    assert (status, "backlash" in error, "'hinge'" in error) == (2, True, True)


@pytest.mark.usefixtures("short_search")
def test_a_motion_that_nothing_explains_ends_in_an_error_and_no_file(batchpid, tmp_path):
    """The sign of the efforts is reversed on all rows that are fitted."""
    (robot := tmp_path / "pendulum.urdf").write_text(PENDULUM)
    log, out = effort_log(tmp_path / "log.csv", wrong=0.75), tmp_path / "motors.yaml"
    flags = ("--compensate", "none", "--timestep", 1e-3, "--workers", 0, "--no-payload", "--out", out)
    status, said, error = batchpid("identify", robot, log, "--evaluations", 2, *flags)
    assert status == 2
    assert "logs: are not explained" in error
    before, after = map(float, ERROR.search(said).groups())
    assert after > before
    assert not out.exists()


def test_params_are_any_gains(batchpid, log, monkeypatch):
    robot, recording, gains = log
    seen = []

    def stop(*_, params, **__):
        seen.append(params)
        raise InvalidArgumentError("params", "were read", remedy="none")

    monkeypatch.setattr("batchpid.sim.identification.identification.identify", stop)
    own = bp.load_params(gains)[0]
    for words in (gains, "designed"):
        status, _, error = batchpid("identify", robot, recording, "--gains", words)
        assert (status, "were read" in error) == (2, True)
    np.testing.assert_array_equal(seen[0].kp, own.kp)
    assert seen[1].gain_units is not None
