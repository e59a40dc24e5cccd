"""Merged links in the engine: the same motion as unmerged, with payloads, watched links and disabled pairs by name."""

import numpy as np
import pytest
from physx_filter import may_touch
from tiny_urdf import INERTIAL, joint, link, random_tree, robot, write

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Runner
from batchpid.sim.engine.physics import PHYSICS
from batchpid.sim.engine.protocol import SceneSpec, Variation
from batchpid.sim.engine.sapien.building import parse
from batchpid.sim.engine.sapien.pack import Pack

BOX = '<collision><origin xyz="0.1 0 0" rpy="0.3 0 0"/><geometry><box size="0.1 0.2 0.3"/></geometry></collision>'
CAPSULE = '<collision><geometry><capsule radius="0.05" length="0.2"/></geometry></collision>'


def spec_of(loaded: Robot, merge_fixed: bool, physics: str = "accurate") -> SceneSpec:
    options = {"ground": False, "merge_fixed": merge_fixed}
    return SceneSpec(loaded.urdf, loaded.ignored_pairs, loaded.joints, 1 / 2000, PHYSICS[physics], **options)


def moved(pack: Pack, reference: Pack, qpos: np.ndarray, steps: int = 2000) -> np.ndarray:
    """Return the positions over ``steps`` under computed torque towards 0.5 rad or m further, with PD at 1 Hz."""
    dof, model = pack.dof, reference.robots[0].create_pinocchio_model()
    pack.write_state([0], qpos[None], np.zeros((1, dof)))
    positions = []
    for _ in range(steps):
        q, v = pack.read_qpos(), pack.read_qvel()
        pull = model.compute_generalized_mass_matrix(q[0]) @ (40 * (qpos + 0.5 - q[0]) - 12 * v[0])
        pack.write_qf(pack.passive_force(True, True) + pull)
        pack.step()
        positions.append(pack.read_qpos()[0])
    return np.array(positions)


@pytest.mark.parametrize(
    ("seed", "physics"),
    [
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((0, "accurate"), (1, "fast"), (2, "accurate"))),
        (3, "fast"),
    ],
)
def test_motion_of_random_trees_is_that_of_all_links(seed, physics, tmp_path):
    rng = np.random.default_rng(seed)
    loaded = Robot.load(write(tmp_path, robot(*random_tree(rng, 9))))
    merged, unmerged = (Pack(spec_of(loaded, merge, physics), 1) for merge in (True, False))
    assert len(merged.robots[0].links) < len(unmerged.robots[0].links)
    qpos = rng.uniform(-1, 1, loaded.dof)
    ours, theirs = (moved(pack, unmerged, qpos) for pack in (merged, unmerged))
    assert np.ptp(theirs, axis=0).min() > 0.4
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5)


def test_motion_of_the_bundled_panda_is_that_of_all_links(panda):
    merged, unmerged = (Pack(spec_of(panda, merge), 1) for merge in (True, False))
    ours, theirs = (moved(pack, unmerged, panda.start, steps=600) for pack in (merged, unmerged))
    assert np.ptp(theirs, axis=0).max() > 0.3
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5)


def arm(tmp_path, tool: str = INERTIAL, **options) -> Robot:
    """Return an arm with a camera on a bent bracket, and a tool whose mass ``tool`` gives."""
    return Robot.load(
        write(
            tmp_path,
            robot(
                link("base"),
                link("upper", INERTIAL + CAPSULE),
                link("lower", INERTIAL + CAPSULE),
                link("bracket", ""),
                link("camera", tool),
                joint("j1", "base", "upper"),
                joint("j2", "upper", "lower", origin="0 0 0.5"),
                joint("f1", "lower", "bracket", "fixed", '<origin xyz="0 0 0.3" rpy="0.4 0.5 0.6"/>'),
                joint("f2", "bracket", "camera", "fixed", '<origin xyz="0.2 0 0" rpy="1 0 0"/>'),
            ),
        ),
        **options,
    )


def mass_matrix(pack: Pack) -> np.ndarray:
    return pack.robots[0].create_pinocchio_model().compute_generalized_mass_matrix(np.array([0.3, -0.4]))


@pytest.mark.parametrize("tool", [INERTIAL + BOX, BOX, BOX + CAPSULE, ""])
def test_mass_is_that_of_all_links(tool, tmp_path):
    loaded = arm(tmp_path, tool)
    merged, unmerged = (Pack(spec_of(loaded, merge), 1) for merge in (True, False))
    assert [each.name for each in merged.robots[0].links] == ["base", "upper", "lower"]
    ours, theirs = (sum(each.mass for each in pack.robots[0].links) for pack in (merged, unmerged))
    assert ours == pytest.approx(theirs, abs=3e-6)  # links of 1e-6 kg
    np.testing.assert_allclose(mass_matrix(merged), mass_matrix(unmerged), atol=2e-5)  # SAPIEN's least inertia


@pytest.mark.parametrize("name", ["camera", "bracket", "lower"])
def test_payload_acts_at_the_link_that_carries_it(name, tmp_path):
    loaded = arm(tmp_path)
    variation = Variation(payload=np.array([1.5]))
    merged, unmerged = (Pack(spec_of(loaded, merge), 1, 0, variation, name, []) for merge in (True, False))
    empty = Pack(spec_of(loaded, True), 1)
    np.testing.assert_allclose(mass_matrix(merged), mass_matrix(unmerged), atol=2e-5)
    assert mass_matrix(merged)[0, 0] > mass_matrix(empty)[0, 0] + 1e-3
    for pack in (merged, unmerged, empty):
        pack.write_state([0], np.array([[0.3, -0.4]]), np.zeros((1, 2)))
    ours, theirs, none = (pack.robots[0].compute_passive_force(True, False) for pack in (merged, unmerged, empty))
    np.testing.assert_allclose(ours, theirs, atol=5e-5)
    assert abs(ours - none).max() > 0.01


def test_poses_of_links_are_watched_by_name(tmp_path):
    def build(scene, env):
        return ["camera", "upper", next(each for each in scene.entities if each.name == "lower")]

    poses = []
    for merge in (True, False):
        loaded = arm(tmp_path, merge_fixed=merge)
        with Runner(loaded, 1, params=loaded.params(kp=5.0), build=build, workers=0) as runner:
            runner.reset(qpos=np.array([0.3, -0.4]))
            poses.append(runner.poses()[0])
    np.testing.assert_allclose(*poses, atol=2e-6)
    with pytest.raises(InvalidArgumentError, match="names of the robot"):
        Runner(loaded, 1, params=loaded.params(kp=5.0), build=lambda scene, env: "lens", workers=0)


def test_a_pair_disabled_by_an_srdf_names_links_within_bodies(tmp_path):
    """The camera may pass through the base, the link that carries it may not."""
    text = '<robot name="r"><disable_collisions link1="base" link2="camera" reason="Default"/></robot>'
    write(tmp_path, text, "test.srdf")
    loaded = arm(tmp_path, BOX)
    write(tmp_path, loaded.path.read_text().replace('<link name="base">', f'<link name="base">{BOX}'))
    pack = Pack(spec_of(Robot.load(loaded.path, self_collision="urdf"), True), 1)
    base, _, lower = pack.robots[0].links
    words = [[shape.get_collision_groups() for shape in each.collision_shapes] for each in (base, lower)]
    assert not may_touch(words[0][0], words[1][1])
    assert may_touch(words[0][0], words[1][0])


def test_equal_specs_share_a_builder_and_differ_by_merging(tmp_path):
    loaded = arm(tmp_path)
    assert parse(spec_of(loaded, True)) is parse(spec_of(loaded, True))
    assert parse(spec_of(loaded, True)) is not parse(spec_of(loaded, False))
