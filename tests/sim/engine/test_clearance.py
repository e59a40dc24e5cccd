"""Proofs that no shapes of a robot in MuJoCo touch: pairs, arms and bounds by MuJoCo's own distances; equal motion."""

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")

from identical import assert_identical  # noqa: E402
from robots import load_bundled  # noqa: E402
from tiny_urdf import random_tree, robot, write  # noqa: E402

from batchpid.sim import Robot, Runner  # noqa: E402
from batchpid.sim.engine import native  # noqa: E402
from batchpid.sim.engine.mujoco import mujoco_step  # noqa: E402
from batchpid.sim.engine.mujoco.model_builder import robot_model  # noqa: E402
from batchpid.sim.engine.mujoco.mujoco_step import GroupClearance, shape_tables  # noqa: E402
from batchpid.sim.engine.protocol import SceneSpec, load_engine  # noqa: E402

MARGIN = 1e-4  # of clearance.h
needs_extension = pytest.mark.skipif(bool(native.obstacle()), reason="there are no native calls")
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


def at(built, qpos, base=()):
    data = mujoco.MjData(built.model)
    data.qpos[: len(base)] = base
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


def arms_of(tables, ways):
    """Return the arms of each pair (pairs, ways)."""
    arms = np.zeros((len(tables["pairs"]), ways))
    for row, first, end in zip(arms, tables["begins"], tables["begins"][1:], strict=False):
        row[tables["arm_ways"][first:end]] = tables["arms"][first:end]
    return arms


def is_upright(built, data, pair):
    """Return whether a pair is of the ground and a cylinder that stands upright on it."""
    kinds = {int(built.model.geom_type[geom]) for geom in pair}
    upright = all(abs(data.geom_xmat[geom][8]) > 1 - 1e-9 for geom in pair)
    return upright and kinds == {int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)}


def test_shapes_close_no_faster_than_their_arms(arm):
    built = model_of(arm)
    tables = shape_tables(built)
    all_arms = arms_of(tables, arm.dof)
    rng = np.random.default_rng(1)
    for qpos in poses(arm, 15):
        moved = np.clip(qpos + rng.normal(scale=rng.choice([0.01, 0.3]), size=arm.dof), arm.lower, arm.upper)
        before, after = at(built, qpos), at(built, moved)
        for pair, arms in list(zip(tables["pairs"], all_arms, strict=True))[:: 1 + len(tables["pairs"]) // 40]:
            closing = distance(built, before, pair) - distance(built, after, pair)
            # MuJoCo's depth of a penetration is not exact, nor its distance of the ground and an upright cylinder.
            if distance(built, after, pair) > 1e-3 and not is_upright(built, after, pair):
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


def step_of(built, data, dof):
    """Return the compiled sim step of one robot."""
    still, nothing = (np.zeros((1, dof)), np.zeros(1, bool)), np.zeros((1, 0))
    return mujoco_step.MujocoStep(built, [built.model], lambda: [data], *still, False, None, sensed=nothing)


@needs_extension
def test_bounds_are_below_the_distances_and_near_them(arm, clearances):
    built = model_of(arm)
    for qpos in poses(arm, 12):
        data = at(built, qpos)
        step = step_of(built, data, arm.dof)
        step(*np.zeros((4, 1, arm.dof)))
        proof = clearances[-1].arrays
        if proof["wait"][0]:
            assert min(distance(built, data, pair) for pair in proof["pairs"]) < 0.01
            continue
        for pair, left in zip(proof["pairs"], clearances[-1].left[0], strict=True):
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


def test_shapes_close_no_faster_than_a_floating_base_moves_them(arm):
    built = model_of(arm, ground=True, fixed_base=False)
    tables = shape_tables(built)
    rng, ways = np.random.default_rng(2), arm.dof + 2
    for qpos in poses(arm, 4, seed=2):
        turn = rng.normal(size=4)
        base = np.array([0, 0, 3, *turn / np.linalg.norm(turn)])
        other = base + np.array([*rng.normal(scale=0.1, size=3), *rng.normal(scale=0.1, size=4)])
        other[3:] /= np.linalg.norm(other[3:])
        angle = 2 * np.arccos(min(1.0, abs(base[3:] @ other[3:])))
        moved = np.append(np.zeros(arm.dof), [np.linalg.norm(other[:3] - base[:3]), angle])
        before, after = (at(built, qpos, floating) for floating in (base, other))
        for pair, arms in zip(tables["pairs"], arms_of(tables, ways), strict=True):
            closing = distance(built, before, pair) - distance(built, after, pair)
            assert closing <= arms @ moved + 1e-5


@needs_extension
@pytest.mark.parametrize("ground", [False, True])
def test_a_falling_robot_moves_the_same_without_proofs(arm, clearances, monkeypatch, ground):
    built = model_of(arm, ground=ground, fixed_base=False)
    states, open_bodies, touched = [], [], 0
    for tables in (shape_tables, lambda robot: None):
        monkeypatch.setattr(mujoco_step, "shape_tables", tables)
        data = at(built, arm.start, [0, 0, 1.5, 1, 0, 0, 0])
        step = step_of(built, data, arm.dof)
        for _ in range(1500):
            step(np.ones((1, arm.dof)), *np.zeros((3, 1, arm.dof)))
            open_bodies.append(int(clearances[0].arrays["open"].sum()))
            touched = max(touched, data.ncon)
        states.append(np.concatenate([data.qpos, data.qvel]))
    assert states[0].tobytes() == states[1].tobytes()
    assert min(open_bodies) < built.model.nbody
    assert not ground or touched


@needs_extension
def test_bodies_that_touch_nothing_are_left_out(clearances):
    panda = Robot.load("panda", self_collision="urdf")
    closed = panda.settings.target.copy()
    closed[-2:] = 0.0
    with Runner(panda, 1, engine="mujoco", workers=0) as runner:
        runner.reset()
        runner.rollout(np.tile(closed, (100, 1)))
    open_bodies = clearances[-1].arrays["open"]
    assert 0 < open_bodies.sum() < open_bodies.size / 2


def test_robots_without_pairs_of_shapes_have_no_tables():
    panda = load_bundled("panda")
    assert shape_tables(model_of(panda, collisions=False)) is None
