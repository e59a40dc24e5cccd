"""Native calls into the engine: bit-identical to Python's, and Python's where they do not work."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled
from tiny_urdf import INERTIAL, LIMIT, joint, link, robot, write

from batchpid.sim import Robot, Runner
from batchpid.sim.engine import native
from batchpid.sim.engine.sapien.pack import Pack
from batchpid.sim.engine.sapien.physics import PHYSICS
from batchpid.sim.engine.scene_spec import SceneSpec

BUILT = not native.status().reason.startswith("the extension was not built")
needs_extension = pytest.mark.skipif(not BUILT, reason="the extension was not built: no C++ compiler")
SOLID = INERTIAL + '<collision><geometry><box size="0.1 0.1 0.3"/></geometry></collision>'


@pytest.fixture(scope="module")
def slider(tmp_path_factory):
    """A rail, a wheel without limits and a hinge, with damping and friction."""
    parts = (
        *(link(name, SOLID) for name in ("base", "cart", "wheel", "arm")),
        joint("rail", "base", "cart", "prismatic", LIMIT),
        joint("spin", "cart", "wheel", "continuous", '<dynamics damping="0.2" friction="0.1"/>'),
        joint("hinge", "wheel", "arm"),
    )
    return Robot.load(write(tmp_path_factory.mktemp("robot"), robot(*parts)))


def rollout(monkeypatch, switch, robot, ticks=12, **options):
    """Return a rollout to seeded setpoints, or under seeded efforts, by native (1) or Python calls (0)."""
    monkeypatch.setenv(native.SWITCH, switch)
    rng = np.random.default_rng(3)
    low, high = np.maximum(robot.lower, -2), np.minimum(robot.upper, 2)
    commands = rng.uniform(low, high, (ticks, 5, robot.dof))
    if options.get("control") == "effort":
        commands = rng.normal(size=commands.shape) * np.minimum(robot.effort_limit, 50)
    with Runner(robot, 5, **({"workers": 0, "substeps": 10} | options)) as runner:
        assert runner.backend.endswith("SAPIEN" if switch == "1" else "switched off by BATCHPID_NATIVE=0)")
        return runner.rollout(commands)


CASES = {
    "tuned": {},
    "drive": {"control": "drive"},
    "efforts, in contact": {"control": "effort"},
    "fast": {"physics": "fast"},
    "without compensation": {"compensate": "none"},
    "a speed limit, which stops envs": {"control": "effort", "speed_limit": 60.0},
}


@pytest.mark.quick_rows(4)
@needs_extension
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("name", "case"),
    [
        ("panda", "tuned"),
        ("panda", "efforts, in contact"),
        ("panda", "a speed limit, which stops envs"),
        *(("slider", case) for case in ("tuned", "drive", "efforts, in contact", "without compensation")),
        *(pytest.param("panda", case, marks=pytest.mark.slow) for case in ("drive", "fast", "without compensation")),
        *(pytest.param("jaco2", case, marks=pytest.mark.slow) for case in ("tuned", "efforts, in contact")),
    ],
)
def test_results_are_bit_identical(monkeypatch, name, case, slider):
    robot = slider if name == "slider" else load_bundled(name)
    ours, theirs = (rollout(monkeypatch, switch, robot, **CASES[case]) for switch in "10")
    assert_identical(ours, theirs)
    assert np.ptp(theirs.qpos, axis=0).max() > 1e-3 or "speed_limit" in CASES[case]


@needs_extension
def test_workers_are_bit_identical_too(monkeypatch, panda):
    ours, theirs = (rollout(monkeypatch, switch, panda, 4, workers=2 * int(switch)) for switch in "10")
    assert_identical(ours, theirs)


@needs_extension
def test_a_robot_whose_scene_is_gone_raises(panda):
    pack = Pack(SceneSpec(panda.urdf, panda.ignored_pairs, panda.joints, 1e-3, PHYSICS["fast"]), 1)
    pack.robots[0].get_links()[0].entity.scene.clear()
    with pytest.raises(RuntimeError):
        pack.read_qpos()


def test_python_calls_without_the_extension(monkeypatch):
    monkeypatch.setenv(native.SWITCH, "0")
    assert native.status() == (False, "native calls are switched off by BATCHPID_NATIVE=0", "")
    assert native.environment() == {"BATCHPID_NATIVE_REFUSED": native.status().reason}


class Told:
    """Controller whose effort is 1 in a process with native calls, else 2."""

    def init(self, robot, num_envs):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return state, np.full_like(qpos, 1.0 if native.status().active else 2.0)


@needs_extension
@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_python_calls_hold_for_the_workers_of_a_runner(panda, workers, monkeypatch):
    monkeypatch.delenv(native.SWITCH, raising=False)
    with native.python_calls():
        runner = Runner(panda, 1, workers=workers, control=Told(), params=panda.params(effort_limit=None))
    with runner:
        effort = runner.step(panda.settings.target).effort
        runner.params = panda.params(effort_limit=50.0)
        runner.reset()
        runner.step(panda.settings.target)
    assert (effort == (1.0 if workers == 0 else 2.0)).all()  # in this process they are switched on again


def test_python_calls_are_those_of_one_thread():
    before = native.status()
    with native.python_calls(), ThreadPoolExecutor(1) as other:
        assert not native.status().active
        assert other.submit(native.status).result() == before


@needs_extension
@pytest.mark.parametrize(
    ("program", "problem"),
    [
        ("raise SystemExit('the results differ')", "the results differ"),
        ("import os; os.abort()", "exit status -6"),
        ("import ctypes; ctypes.string_at(8)", "exit status -11"),
    ],
)
def test_a_failed_self_test_is_a_warning(monkeypatch, tmp_path, program, problem):
    monkeypatch.delenv("BATCHPID_NATIVE_VERIFIED", raising=False)
    status = native.verify(tmp_path, program)
    warning = f"native calls do not work with this SAPIEN: {problem}"
    assert status == (False, f"the self-test failed: {problem}", warning)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@needs_extension
def test_the_self_test_runs_once_for_a_pair_of_libraries(monkeypatch, tmp_path):
    monkeypatch.delenv("BATCHPID_NATIVE_VERIFIED", raising=False)
    assert native.verify(tmp_path / "cache").active
    assert len(list((tmp_path / "cache").iterdir())) == 1
    assert native.verify(tmp_path / "cache", "raise SystemExit('not run again')").active
    (tmp_path / "file").touch()
    assert native.verify(tmp_path / "file").active  # an unwritable cache is not used
