"""Robots with a floating base: its pose and twist in observations, resets, recordings and
snapshots.
"""

import contextlib

import numpy as np
import pytest
from legged import DOG, GAINS, GRAVITY, STOOL, load

from batchpid.sim import Randomization, Runner, Uniform


@pytest.fixture
def quadruped(tmp_path):
    """A trunk of 10 kg on four legs that slide, each with a mass of 0.3 kg."""
    return load(tmp_path)


def test_a_fast_base_keeps_its_speed(quadruped, engine):
    """v = v0 - g t for 2 s, and w about w0: PhysX stops links at 10 m/s and 50 rad/s by default."""
    with Runner(quadruped, 1, params=quadruped.params(**GAINS), workers=0) as runner:
        runner.reset(base_pose=[0, 0, 60, 1, 0, 0, 0], base_twist=[15, 0, 0, 0, 0, 80])
        seen = runner.rollout(np.tile(quadruped.start, (200, 1))).base_twist[-1, 0]
    np.testing.assert_allclose(seen[2], -2 * GRAVITY, rtol=0.05)
    assert 60 < seen[5] < 81
    assert np.hypot(*seen[:2]) > 14


def test_a_pose_of_the_legs_sets_the_height(quadruped, engine):
    poses = np.stack([np.full(4, -0.05), np.full(4, 0.08)])
    with Runner(quadruped, 2, params=quadruped.params(**GAINS), workers=0) as runner:
        heights = runner.reset(qpos=poses).base_pose[:, 2]
        np.testing.assert_allclose(heights, [0.43, 0.30], atol=1e-6)
        part = runner.reset(qpos=poses[::-1], mask=np.array([True, False])).base_pose[:, 2]
        np.testing.assert_allclose(part, [0.30, 0.30], atol=1e-6)
        given = np.array([[0.1, 0.2, 3.0, 2.0, 0, 0, 0], [0, 0, 1.0, 0, 0, 0, -1.0]])
        found = runner.reset(base_pose=given).base_pose
        np.testing.assert_allclose(found[:, 3:], [[1, 0, 0, 0], [0, 0, 0, -1]], atol=1e-6)
        np.testing.assert_allclose(found[:, :3], given[:, :3], atol=1e-6)
    with Runner(quadruped, 1, params=quadruped.params(**GAINS), workers=0, ground=False) as runner:
        np.testing.assert_allclose(runner.observe().base_pose[0, :3], 0, atol=1e-7)


def test_the_twist_is_that_of_the_root_link_in_the_world(quadruped, engine):
    """In free flight its center of mass moves on a parabola; the origin of the trunk turns about
    it.
    """
    pose, twist = [0, 0, 0, 0.8, 0.6, 0, 0], [1.0, 0, 0, 2.0, 4.0, 8.0]
    options = {
        "workers": 0,
        "compensate": "none",
        "substeps": 1,
        "control": "effort",
    }
    options["ground"] = False
    with Runner(quadruped, 1, **options) as runner:
        begin = runner.reset(base_pose=pose, base_twist=twist)
        np.testing.assert_allclose(begin.base_twist[0], twist, atol=1e-5)
        flight = runner.rollout(np.zeros((40, 4)))
    moved = np.diff(flight.base_pose[:, 0, :3].astype(float), axis=0) * 2000
    middle = 0.5 * (flight.base_twist[1:, 0, :3] + flight.base_twist[:-1, 0, :3])
    np.testing.assert_allclose(moved, middle, atol=5e-3)
    assert np.abs(np.ptp(flight.base_twist[:, 0, :3], axis=0)).min() > 0.01
    rates = np.diff(flight.base_pose[:, 0, 3:].astype(float), axis=0) * 2000  # dq/dt = w q / 2
    w, x, y, z = flight.base_pose[:-1, 0, 3:].T.astype(float)
    wx, wy, wz = flight.base_twist[:-1, 0, 3:].T.astype(float)
    np.testing.assert_allclose(rates[:, 0], -0.5 * (wx * x + wy * y + wz * z), atol=0.01)
    np.testing.assert_allclose(rates[:, 1], 0.5 * (wx * w + wy * z - wz * y), atol=0.01)


class Counted(Uniform):
    """Uniform distribution that counts its draws."""

    draws = 0

    def sample(self, generator, size):
        Counted.draws += 1
        return super().sample(generator, size)


def test_a_push_changes_the_twist_of_the_base_at_a_tick(quadruped, engine):
    push = {
        "vx": Uniform(0.5, 1.0),
        "vy": Uniform(-1, 1),
        "wx": Uniform(2, 3),
        "wz": Uniform(-2, 2),
    }
    randomization = Randomization(push=push, push_interval=Counted(0.055, 0.055))
    options = {
        "control": "effort",
        "compensate": "none",
        "workers": 0,
        "ground": False,
    }
    with Runner(quadruped, 2, randomization=randomization, **options) as runner:
        runner.reset(base_pose=[0, 0, 0, 0.9, 0.1, 0.3, 0.2])
        still = runner.rollout(np.zeros((6, 4)))
        assert np.abs(still.base_twist[..., [0, 1, 3, 4, 5]]).max() < 1e-4
        Counted.draws = 0
        before, after = still.base_twist[-1], runner.step(np.zeros(4), substeps=1).base_twist
        assert Counted.draws == 2, "the next interval of each env, drawn once"
        assert (after[:, 0] - before[:, 0] > 0.49).all()
        assert (after[:, 3] > 1.9).all()
        assert np.ptp(after[:, 0]) > 1e-3
        assert (
            np.abs(runner.rollout(np.zeros((4, 4))).base_twist[-1, :, 0] - after[:, 0]).max() < 0.2
        )


def test_a_block_slides_down_a_slope_as_it_should(tmp_path, engine):
    """Tilted gravity makes a slope: the acceleration is g (sin a - mu cos a), the force of friction
    mu m g cos a.
    """
    block = load(tmp_path, BLOCK)
    angle, friction = 0.5, 0.2
    down = {"x": GRAVITY * np.sin(angle), "z": GRAVITY * (1 - np.cos(angle))}
    world = Randomization(
        gravity={axis: Uniform(value, value) for axis, value in down.items()},
        ground_friction=Uniform(friction, friction, operation="abs"),
    )
    options = {
        "params": block.params(kp=200, ki=0, kd=5),
        "randomization": world,
        "contacts": ["block"] if engine == "mujoco" else None,
    }
    with Runner(block, 1, workers=0, **options) as runner:
        slide = runner.rollout(np.tile(block.start, (60, 1)))
    speeds = slide.base_twist[20:, 0, 0].astype(float)
    found = (speeds[-1] - speeds[0]) / (slide.time[-1] - slide.time[20])
    np.testing.assert_allclose(
        found, GRAVITY * (np.sin(angle) - friction * np.cos(angle)), rtol=0.01
    )
    normal = 2.1 * GRAVITY * np.cos(angle)
    if engine == "mujoco":
        force = slide.contact_force[30:, 0].mean((0, 1))
        np.testing.assert_allclose(force, [-friction * normal, 0, normal], atol=0.01 * normal)


BLOCK = """<robot name="block">
  <link name="block"><inertial><mass value="2"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.4 0.4 0.05"/></geometry></collision></link>
  <link name="knob"><inertial><mass value="0.1"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="block"/><child link="knob"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" effort="5" velocity="5"/></joint></robot>"""


def test_gravity_is_compensated_as_if_the_base_were_held(quadruped, engine):
    """Each leg is carried by its own effort, however the trunk stands; Coriolis forces of a turning
    base included.
    """
    with Runner(
        quadruped,
        1,
        params=quadruped.params(kp=0, ki=0, kd=0),
        workers=0,
        ground=False,
    ) as runner:
        for pose in ([0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 1, 0, 0], [0, 0, 0, 0.8, 0.6, 0, 0]):
            runner.reset(base_pose=pose)
            upright = 1 - 2 * (pose[4] ** 2 + pose[5] ** 2)
            effort = runner.step(quadruped.start, substeps=1).effort[0]
            np.testing.assert_allclose(effort, 0.3 * GRAVITY * upright, atol=1e-4)
        runner.reset(base_twist=[0, 0, 0, 3.0, 0, 0])
        effort = runner.step(quadruped.start, substeps=1).effort[0]
        np.testing.assert_allclose(
            effort, 0.3 * GRAVITY + 9.0 * (0.2 * 0.2 + 0.1 * 0.35), rtol=1e-4
        )


def test_designed_gains_carry_the_base(tmp_path, engine):
    """By default a dog on bent legs stands; with gains for legs in the air it sinks down."""
    dog, sinks = load(tmp_path, DOG), []
    for params in (None, dog.designed("mass_matrix")):
        with Runner(dog, 1, workers=0, params=params) as runner:
            start = runner.observe().base_pose[0]
            stood = runner.rollout(np.tile(dog.start, (60, 1)))
        sinks.append(np.abs(stood.base_pose[:, 0, :3] - start[:3]).max())
        tilts = np.degrees(2 * np.hypot(*stood.base_pose[:, 0, 4:6].T))
        assert params is not None or tilts.max() < 3
    assert sinks[0] < 0.02
    assert sinks[1] > 2 * sinks[0]


def test_a_free_joint_at_the_root_makes_a_floating_base(tmp_path):
    free = (
        '<link name="world"/><joint name="free" type="floating"><parent link="world"/><child'
        ' link="trunk"/></joint>'
    )
    text = STOOL.replace("</robot>", free + "</robot>")
    table, held = (load(tmp_path, text, fixed_base=fixed) for fixed in (None, True))
    assert (table.fixed_base, held.fixed_base) == (False, True)
    assert held.tables.links.keys() - table.tables.links.keys() == {"world"}
    with Runner(table, 1, params=table.params(**GAINS), workers=0, engine="mujoco") as runner:
        np.testing.assert_allclose(runner.observe().base_pose[0, :3], [0, 0, 0.38], atol=1e-6)
    assert "fixed instead" in str(held.check())
    assert "fixed instead" not in str(table.check())
    origin = '<origin xyz="1 2 .7" rpy="0 0 1.5707963"/>'
    moved = text.replace('<child link="trunk"/>', f'<child link="trunk"/>{origin}')
    with Runner(
        load(tmp_path, moved, fixed_base=None),
        1,
        params=table.params(**GAINS),
        workers=0,
        engine="mujoco",
    ) as runner:
        pose = runner.observe().base_pose[0]
    np.testing.assert_allclose(pose, [1, 2, 0.7, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-6)


def test_tasks_observe_the_base(quadruped):
    gym = pytest.importorskip("batchpid.sim.gym")
    with contextlib.closing(gym.ReachVectorEnv(2, quadruped, workers=0, engine="mujoco")) as env:
        observation, _ = env.reset(seed=0)
        seen = env.runner.observe()
        np.testing.assert_array_equal(observation[:, 8:15], seen.base_pose)
        np.testing.assert_array_equal(observation[:, 15:21], seen.base_twist)
        assert env.single_observation_space.shape == observation.shape[1:] == (8 + 13 + 4,)
