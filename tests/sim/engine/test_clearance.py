"""Proofs that no shapes of a robot in MuJoCo touch: pairs, arms and bounds by MuJoCo's own distances; equal motion."""

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from identical import assert_identical  # noqa: E402
from robots import load_bundled  # noqa: E402
from tiny_urdf import random_tree, robot, write  # noqa: E402

from batchpid.sim import Robot, Runner  # noqa: E402
from batchpid.sim.engine import native  # noqa: E402
from batchpid.sim.engine.engines import load_engine  # noqa: E402
from batchpid.sim.engine.mujoco import mujoco_step  # noqa: E402
from batchpid.sim.engine.mujoco.clearance import GroupClearance, shape_tables  # noqa: E402
from batchpid.sim.engine.mujoco.model_builder import robot_model  # noqa: E402
from batchpid.sim.engine.scene_spec import SceneSpec  # noqa: E402

MARGIN = 1e-4  # of clearance.h
needs_extension = pytest.mark.skipif(not native.status().active, reason="there are no native calls")
pytestmark = pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning", "ignore::batchpid.sim.FaultWarning")


KINDS = (
    '<sphere radius="0.2"/>',
    '<box size="0.1 0.3 0.5"/>',
    '<cylinder radius="0.1" length="0.6"/>',
    '<capsule radius="0.1" length="0.4"/>',
    '<mesh filename="hull.obj"/>',
)
HULL = "v 0 0 0\nv 0.4 0 0\nv 0 0.3 0\nv 0 0 0.5\nv 0.2 0.2 0.2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 5\nf 2 5 4\nf 3 4 5\n"


def shaped_tree(seed, folder):
    """Return a robot of random joints and shapes of every kind, loosely spread."""
    rng = np.random.default_rng(seed)
    (folder / "hull.obj").write_text(HULL)
    parts = random_tree(rng, 9)
    for number, part in enumerate(parts):
        if part.startswith("<link"):
            place = '<origin xyz="{} {} {}" rpy="{} {} {}"/>'.format(*rng.uniform(-0.5, 0.5, 6))
            shape = f"<collision>{place}<geometry>{KINDS[number % len(KINDS)]}</geometry></collision>"
            parts[number] = part.replace("</link>", shape + "</link>")
    return Robot.load(write(folder, robot(*parts)))


def model_of(of, **changes):
    physics = load_engine("mujoco").physics["accurate"]
    return robot_model(SceneSpec(of.urdf, of.ignored_pairs, of.joints, 5e-4, physics, engine="mujoco", **changes))


@pytest.fixture(
    params=["panda", "tree 0", *(pytest.param(each, marks=pytest.mark.slow) for each in ("jaco2", "tree 1"))],
)
def arm(request, tmp_path):
    name, *seed = request.param.split()
    return shaped_tree(int(seed[0]), tmp_path) if seed else load_bundled(name)


def poses(of, count, seed=0):
    lower, upper = np.maximum(of.lower, -3.0), np.minimum(of.upper, 3.0)
    return np.random.default_rng(seed).uniform(lower, upper, (count, of.dof))


def at(built, qpos):
    data = mujoco.MjData(built.model)
    data.qpos[built.qpos] = qpos
    mujoco.mj_step1(built.model, data)
    return data


def distance(built, data, pair):
    """Return the distance of two shapes by MuJoCo [m], at most 10."""
    return mujoco.mj_geomDistance(built.model, data, int(pair[0]), int(pair[1]), 10.0, np.zeros(6))


@pytest.mark.parametrize("ground", [False, True])
def test_every_contact_is_of_a_pair(arm, ground):
    built = model_of(arm, ground=ground)
    pairs = {tuple(sorted(pair)) for pair in shape_tables(built)["pairs"].tolist()}
    touched = set()
    for qpos in poses(arm, 100):
        data = at(built, qpos)
        touched |= {tuple(sorted(pair)) for pair in data.contact.geom[: data.ncon].tolist()}
    assert touched <= pairs
    assert touched, "no pose has a contact"


def test_shapes_close_no_faster_than_their_arms(arm):
    built = model_of(arm)
    tables = shape_tables(built)
    rng = np.random.default_rng(1)
    for qpos in poses(arm, 15):
        moved = np.clip(qpos + rng.normal(scale=rng.choice([0.01, 0.3]), size=arm.dof), arm.lower, arm.upper)
        before, after = at(built, qpos), at(built, moved)
        for pair, arms in list(zip(tables["pairs"], tables["arms"], strict=True))[:: 1 + len(tables["pairs"]) // 40]:
            closing = distance(built, before, pair) - distance(built, after, pair)
            if distance(built, after, pair) > 1e-3:  # MuJoCo's depth of a penetration is not exact
                assert closing <= arms @ np.abs(moved - qpos) + 1e-5


@pytest.fixture
def clearances(monkeypatch):
    """Clearances of the native steps made from now on."""
    made = []

    class Recorded(GroupClearance):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr(mujoco_step, "GroupClearance", Recorded)
    return made


@needs_extension
def test_bounds_are_below_the_distances_and_near_them(arm, clearances):
    built = model_of(arm)
    for qpos in poses(arm, 12):
        data = at(built, qpos)
        step = mujoco_step.MujocoStep(
            built, [built.model], lambda data=data: [data], np.zeros((1, arm.dof)), np.zeros(1, bool), False, None
        )
        step(*np.zeros((4, 1, arm.dof)))
        proof = clearances[-1].arrays
        if proof["wait"][0]:
            assert min(distance(built, data, pair) for pair in proof["pairs"]) < 0.01
            continue
        for pair, left in zip(proof["pairs"], proof["left"][0], strict=True):
            exact = distance(built, data, pair)
            assert left + MARGIN <= exact + 1e-6
            assert left + MARGIN >= 0.3 * exact


def motion(of, **options):
    """Run 4 envs through random poses, half of them placed elsewhere on the way; return the rollouts."""
    goals = np.repeat(poses(of, 12, seed=3).reshape(3, 4, of.dof), 8, axis=0)
    with Runner(of, 4, engine="mujoco", workers=0, **options) as runner:
        runner.reset()
        first = runner.rollout(goals[:12])
        runner.reset(poses(of, 4, seed=4), mask=[False, True, False, True])
        return first, runner.rollout(goals[12:])


@needs_extension
def test_a_motion_is_the_same_without_proofs(arm, clearances, monkeypatch):
    physics = "accurate" if arm.name == "panda" else "fast"
    ours = motion(arm, physics=physics)
    assert clearances
    monkeypatch.setattr(mujoco_step, "shape_tables", lambda robot: None)
    for mine, plain in zip(ours, motion(arm, physics=physics), strict=True):
        assert_identical(mine, plain)


@needs_extension
def test_most_steps_of_a_free_motion_need_no_contacts(clearances):
    panda = load_bundled("panda")
    with Runner(panda, 4, engine="mujoco", workers=0) as runner:
        runner.reset()
        for _ in range(30):
            runner.step(panda.settings.target)
            assert not clearances[-1].arrays["wait"].any()


@needs_extension
def test_a_falling_robot_moves_the_same_without_proofs(clearances, monkeypatch):
    panda = load_bundled("panda")
    built = model_of(panda, ground=False, fixed_base=False)
    states = []
    for tables in (shape_tables, lambda robot: None):
        monkeypatch.setattr(mujoco_step, "shape_tables", tables)
        data = at(built, panda.start)
        still = np.zeros((1, panda.dof)), np.zeros(1, bool)
        step = mujoco_step.MujocoStep(built, [built.model], lambda data=data: [data], *still, False, None)
        for _ in range(200):
            step(np.ones((1, panda.dof)), *np.zeros((3, 1, panda.dof)))
        states.append(np.concatenate([data.qpos, data.qvel]))
    assert not clearances[0].arrays["wait"].any()
    assert states[0].tobytes() == states[1].tobytes()
    assert np.abs(states[0][:3]).max() > 0.01


def test_a_floating_robot_over_ground_is_always_looked_at():
    panda = load_bundled("panda")
    assert shape_tables(model_of(panda, ground=True, fixed_base=False)) is None
    assert shape_tables(model_of(panda, ground=False, fixed_base=False)) is not None
    assert shape_tables(model_of(panda, collisions=False)) is None
