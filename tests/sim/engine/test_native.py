"""Native calls into the engine: bit-identical to Python's, and Python's where they do not work."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled
from tiny_urdf import INERTIAL, LIMIT, joint, link, robot, write

from batchpid.native.extensions import NOT_BUILT
from batchpid.sim import Robot, Runner
from batchpid.sim.engine import native
from batchpid.sim.engine.physics import PHYSICS
from batchpid.sim.engine.protocol import SceneSpec
from batchpid.sim.engine.sapien.building import build_scene, new_system
from batchpid.sim.engine.sapien.calls import NativeCalls, PythonCalls
from batchpid.sim.engine.sapien.pack import Pack

needs_extension = pytest.mark.skipif(native.obstacle() == NOT_BUILT, reason=NOT_BUILT)
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


SPECS = {
    "slider": {},
    "panda": {},
    "panda, fast": {"physics": PHYSICS["fast"]},
    "panda, no shapes": {"collisions": False},
}


def spec_of(case, slider):
    robot = slider if case == "slider" else load_bundled("panda")
    spec = SceneSpec(robot.urdf, robot.ignored_pairs, robot.joints, 1e-3, PHYSICS["accurate"])
    return replace(spec, **SPECS[case]), np.clip(robot.start, robot.lower, robot.upper)


@needs_extension
@pytest.mark.parametrize("case", SPECS)
@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_each_native_call_is_sapiens(case, gravity, dtype, slider):
    """Efforts vary, one robot is skipped, and a robot whose scene is gone is an error of both."""
    (spec, start), found = spec_of(case, slider), []
    for make in (PythonCalls, NativeCalls):
        systems = [new_system(spec) for _ in range(4)]
        scenes, robots = zip(*(build_scene(spec, system) for system in systems), strict=True)
        qf, reads = np.zeros((4, len(start)), np.float32), []
        for row, each in enumerate(robots):
            each.set_qpos((start + 0.01 * row).astype(np.float32))
        calls = make(robots, systems, qf, np.array([False, False, False, True]))
        for step in range(30):
            qf[...] = calls.passive_force(True, True, np.float64) + np.sin(step + np.arange(len(start)))
            calls.write_qf()
            calls.step()
            reads += [calls.qpos(dtype), calls.qvel(dtype), calls.passive_force(gravity, True, dtype)]
        for scene in scenes:
            scene.clear()
        with pytest.raises(RuntimeError):
            calls.qpos(dtype)
        found.append(reads)
    for theirs, ours in zip(*found, strict=True):
        assert ours.dtype == theirs.dtype == dtype
        assert ours.tobytes() == theirs.tobytes()
    assert np.ptp(found[0][-3], axis=0).any()


@needs_extension
@pytest.mark.parametrize("case", SPECS)
def test_a_native_sim_step_is_the_calls_one_after_another(monkeypatch, case, slider):
    (spec, start), packs = spec_of(case, slider), []
    for switch in "10":
        monkeypatch.setenv(native.SWITCH, switch)
        packs.append(Pack(spec, 4))
    ours, theirs = packs
    for pack in packs:
        pack.write_state(range(4), np.linspace(start, start + 0.1, 4), np.zeros((4, len(start))))
    table = np.zeros((3, 4, len(start)))
    step = ours.compiled_step(True, True, True, None)
    for number in range(50):
        effort = np.tile(5.0 * np.sin(number + np.arange(len(start))), (4, 1))
        theirs.write_qf(effort)
        theirs.step()
        assert step(effort, *table) == 0
        reads = theirs.read_qpos(), theirs.read_qvel(), theirs.passive_force(True, True)
        assert np.array(reads).tobytes() == table.tobytes()
    assert np.abs(table[0] - start).max() > 1e-3
