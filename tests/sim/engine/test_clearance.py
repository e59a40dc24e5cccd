"""MuJoCo's contacts with and without proofs of clearance: proofs skip no contact, so the motion is
the same.
"""

import copy
import os

import mujoco
import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled
from tiny_urdf import INERTIAL, joint, link, random_tree, robot, write

from batchpid.sim import MujocoSolver, Robot, Runner
from batchpid.sim.engine.mujoco.model_builder import robot_model
from batchpid.sim.engine.scene_spec import SceneSpec

pytestmark = pytest.mark.filterwarnings(
    "ignore::batchpid.sim.StabilityWarning", "ignore::batchpid.sim.FaultWarning"
)
KINDS = (
    '<sphere radius="0.2"/>',
    '<box size="0.1 0.3 0.5"/>',
    '<cylinder radius="0.1" length="0.6"/>',
    '<capsule radius="0.1" length="0.4"/>',
    '<mesh filename="hull.obj"/>',
)
HULL = (
    "v 0 0 0\nv 0.4 0 0\nv 0 0.3 0\nv 0 0 0.5\nv 0.2 0.2 0.2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 5\nf"
    " 2 5 4\nf 3 4 5\n"
)


def shaped_tree(seed, folder, links=9, **options):
    """Return a robot of random joints and shapes of every kind, loosely spread."""
    rng = np.random.default_rng(seed)
    (folder / "hull.obj").write_text(HULL)
    parts = random_tree(rng, links)
    for number, part in enumerate(parts):
        if part.startswith("<link"):
            place = '<origin xyz="{} {} {}" rpy="{} {} {}"/>'.format(*rng.uniform(-0.5, 0.5, 6))
            shape = (
                f"<collision>{place}<geometry>{KINDS[number % len(KINDS)]}</geometry></collision>"
            )
            parts[number] = part.replace("</link>", shape + "</link>")
    return Robot.load(write(folder, robot(*parts)), **options)


def motion(of, monkeypatch, proofs, ticks=30, **options):
    """Return rollouts of 4 robots from random poses under random efforts, with a reset of two
    between them.
    """
    rng, envs = np.random.default_rng(1), 4
    if not proofs:
        monkeypatch.setattr(
            "batchpid.sim.engine.mujoco.mujoco_step.shape_tables", lambda robot: None
        )
    starts = rng.uniform(np.maximum(of.lower, -3.0), np.minimum(of.upper, 3.0), (envs, of.dof))
    efforts = np.tile(
        rng.normal(size=(envs, of.dof)) * np.minimum(of.effort_limit, 20), (ticks, 1, 1)
    )
    given = {
        "engine": "mujoco",
        "workers": 0,
        "control": "effort",
        "compensate": "none",
        "substeps": 10,
        **options,
    }
    with Runner(of, envs, **given) as runner:
        base = {} if of.fixed_base else {"base_pose": [0, 0, 1.5, 1, 0, 0, 0]}
        runner.reset(starts, **base)
        first = runner.rollout(efforts)
        runner.reset(mask=np.arange(envs) % 2 == 0, **base)
        return first, runner.rollout(efforts)


CASES = [
    *(("panda", True, ground) for ground in (False, True)),
    *(
        (seed, fixed, ground)
        for seed in (0,)
        for fixed in (True, False)
        for ground in (False, True)
    ),
    pytest.param("jaco2", True, True, marks=pytest.mark.slow),
    *(pytest.param(seed, False, True, marks=pytest.mark.slow) for seed in range(1, 12)),
]


@pytest.mark.skipif(os.environ.get("BATCHPID_NATIVE") == "0", reason="there are no native calls")
@pytest.mark.parametrize(("name", "fixed_base", "ground"), CASES)
def test_a_motion_is_the_same_without_proofs(name, fixed_base, ground, tmp_path, monkeypatch):
    """Without proofs MuJoCo looks for contacts in every step."""
    of = (
        load_bundled(name)
        if isinstance(name, str)
        else shaped_tree(name, tmp_path, fixed_base=fixed_base)
    )
    ours, theirs = (motion(of, monkeypatch, proofs, ground=ground) for proofs in (True, False))
    for one, other in zip(ours, theirs, strict=True):
        assert_identical(one, other)
    if fixed_base and not ground:
        poses = np.concatenate([each.qpos.reshape(-1, of.dof) for each in theirs])
        assert of.dynamics(ground=False).in_contact(poses, 0.02).any(), (
            "no links come near each other"
        )


@pytest.mark.skipif(os.environ.get("BATCHPID_NATIVE") == "0", reason="there are no native calls")
def test_a_link_that_is_welded_far_out_stops_at_an_obstacle(tmp_path, monkeypatch):
    """A link with a wrench is a body of its own, with a pose in the body that carries it."""
    ball = (
        '<collision><origin xyz="0 0 {}"/><geometry><sphere radius="0.1"/></geometry></collision>'
    )
    parts = link("a", ball.format(1.5)), link("b"), link("c", INERTIAL + ball.format(0))
    hinge = joint("j", "a", "b", "continuous", origin="0 0 0")
    weld = joint("k", "b", "c", "fixed", "", "1.5 0 0")
    arm = Robot.load(write(tmp_path, robot(*parts, hinge, weld)), self_collision="urdf")
    options = {"ticks": 300, "wrenches": ["c"]}
    ours, theirs = (motion(arm, monkeypatch, proofs, **options) for proofs in (True, False))
    for one, other in zip(ours, theirs, strict=True):
        assert_identical(one, other)


def test_the_form_of_the_solver_changes_rounding_alone(tmp_path):
    """A sparse Jacobian without islands, against MuJoCo's default, with contacts."""
    of = shaped_tree(0, tmp_path, links=26, fixed_base=False)
    parts = of.tables, of.self_contact.ignored, of.joints, 1e-3, MujocoSolver()
    ours = robot_model(SceneSpec(*parts, fixed_base=False)).model
    theirs = copy.copy(ours)
    theirs.opt.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    theirs.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    assert mujoco.mj_isSparse(ours)
    assert not mujoco.mj_isSparse(theirs)
    first, second = mujoco.MjData(ours), mujoco.MjData(theirs)
    touched = 0
    for _ in range(50):
        mujoco.mj_step(ours, first)
        mujoco.mj_step(theirs, second)
        touched += first.ncon
    assert touched
    np.testing.assert_allclose(first.qpos, second.qpos, rtol=0, atol=1e-10)
