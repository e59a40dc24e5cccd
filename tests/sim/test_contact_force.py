"""Contact forces of links in both engines, and wrenches."""

import numpy as np
import pytest
from identical import assert_identical
from legged import FEET, GAINS, GRAVITY, STOOL, WEIGHT, load

from batchpid.sim import Runner


@pytest.fixture
def stool(tmp_path):
    """A trunk of 10 kg on four legs that slide, with balls as feet that a fixed joint holds."""
    return load(tmp_path)


def make_runner(robot, num_envs=1, **options):
    chosen = {"workers": 0, "contacts": [*FEET, "trunk"], "params": robot.params(**GAINS)} | options
    return Runner(robot, num_envs, **chosen)


def stand(robot, ticks=60, **options):
    with make_runner(robot, **options) as runner:
        return runner.rollout(np.tile(robot.start, (ticks, 1)))


def test_contact_forces_of_a_standing_robot_carry_its_weight(stool, engine):
    rollout = stand(stool)
    np.testing.assert_allclose(rollout.base_pose[-1, 0, :4], [0, 0, 0.38, 1], atol=5e-3)
    assert np.abs(rollout.base_twist[-1]).max() < 0.01
    # SAPIEN's are of single sim steps.
    forces, efforts = (rows[-20:, 0].mean(0) for rows in (rollout.contact_force, rollout.effort))
    np.testing.assert_allclose(forces[:, 2].sum(), WEIGHT, rtol=5e-3)
    assert np.abs(forces[:, :2].sum(0)).max() < 5e-3 * WEIGHT
    np.testing.assert_allclose(forces[:4, 2], 0.3 * GRAVITY - efforts, rtol=5e-3)
    assert rollout.touching[-1, 0].tolist() == [True] * 4 + [False]
    assert (forces[4] == 0).all()


def test_a_link_senses_its_own_contacts_and_not_those_of_the_links_beside_it(tmp_path, engine):
    """A toe in the air on a foot on the ground, and a sensor without shapes; all on fixed joints."""
    toe = """<link name="toe"><inertial><mass value="0.01"/><inertia ixx="1e-5" iyy="1e-5" izz="1e-5"/>
      </inertial><collision><geometry><sphere radius="0.02"/></geometry></collision></link>
      <joint name="t" type="fixed"><parent link="foot0"/><child link="toe"/><origin xyz="0.1 0 0.1"/></joint>
      <link name="imu"/><joint name="i" type="fixed"><parent link="trunk"/><child link="imu"/></joint>"""
    robot = load(tmp_path, STOOL.replace("</robot>", f"{toe}</robot>"))
    rollout = stand(robot, contacts=["toe", "foot0", "imu"])
    assert rollout.touching[-1, 0].tolist() == [False, True, False]
    assert not rollout.contact_force[-1, 0, [0, 2]].any()
    assert rollout.contact_force[-1, 0, 1, 2] > 0.2 * WEIGHT


def test_a_wrench_holds_the_links_behind_it(stool):
    """Foot on the ground: its weight, the contact force, and the wrench of the leg cancel."""
    rollout = stand(stool, wrenches=["foot1", "leg1"])
    assert rollout.info.units_of("wrench") == ("N",) * 3 + ("N m",) * 3
    force, wrench = (
        rollout.contact_force[-1, 0, 1].astype(float),
        rollout.wrench[-1, 0].astype(float),
    )
    turned = np.array([[np.cos(0.5), np.sin(0.5), 0], [-np.sin(0.5), np.cos(0.5), 0], [0, 0, 1]])
    expected = -(turned @ force) + [0, 0, 0.1 * GRAVITY]
    np.testing.assert_allclose(wrench[0, :3], expected, atol=0.05)
    np.testing.assert_allclose(wrench[0, 3:], np.cross([0, 0, -0.33], -(turned @ force)), atol=0.05)
    np.testing.assert_allclose(wrench[1, :3], -force + [0, 0, 0.3 * GRAVITY], atol=0.05)


def test_nothing_touches_in_free_fall(stool, engine):
    with make_runner(stool, control="effort", compensate="none") as runner:
        begin = runner.reset(
            base_pose=[0, 0, 2.0, 0.9, 0.1, 0.2, 0.3], base_twist=[0.1, 0, 0, 1.0, 2.0, 3.0]
        )
        assert not begin.contact_force.any()
        fall = runner.rollout(np.zeros((10, 4)))
    assert not fall.contact_force.any()
    assert not fall.touching.any()


def test_an_observed_contact_changes_nothing(stool, engine):
    first = stand(stool, 30, contacts=None)
    assert first.contact_force is None
    assert_identical(first, stand(stool, 30), skip=("contact_force", "touching"))


@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")
def test_an_env_that_fails_has_no_force(stool, engine):
    with make_runner(stool, 2, on_invalid_input="contain") as runner:
        bad = np.tile(stool.start, (2, 1))
        for _ in range(30):
            before = runner.step(bad)
        bad[0] = np.nan
        seen = runner.step(bad)
    assert before.touching[:, :4].all()
    assert seen.touching.any(1).tolist() == [False, True]
    assert not seen.contact_force[0].any()
