"""Merged links: the same motion as unmerged, with payloads, observed links and disabled pairs by
name.
"""

import numpy as np
import pytest
from tiny_urdf import INERTIAL, joint, link, random_tree, robot, write

import batchpid.task_space as ts
from batchpid.sim import Randomization, Robot, Runner, Uniform
from batchpid.sim.robot.robot_model import link_tree

BOX = (
    '<collision><origin xyz="0.1 0 0" rpy="0.3 0 0"/><geometry><box size="0.1 0.2'
    ' 0.3"/></geometry></collision>'
)
CAPSULE = '<collision><geometry><capsule radius="0.05" length="0.2"/></geometry></collision>'


def arm(tool=INERTIAL):
    """Return an arm with a camera on a bent bracket, and a tool whose mass ``tool`` gives."""
    return robot(
        *(
            link("base"),
            link("upper", INERTIAL + CAPSULE),
            link("lower", INERTIAL + CAPSULE),
            link("bracket", ""),
        ),
        *(
            link("camera", tool),
            joint("j1", "base", "upper"),
            joint("j2", "upper", "lower", origin="0 0 0.5"),
        ),
        joint("f1", "lower", "bracket", "fixed", '<origin xyz="0 0 0.3" rpy="0.4 0.5 0.6"/>'),
        joint("f2", "bracket", "camera", "fixed", '<origin xyz="0.2 0 0" rpy="1 0 0"/>'),
    )


def load(folder, text):
    return Robot.load(write(folder, text))


def fixed_links(of):
    """Return the links that fixed joints hold; with wrenches measured, they are not merged."""
    return [each.child_link for each in of.tables.joints if not each.moves]


def motion(of, ticks=30, **options):
    efforts = 0.5 * np.sin(0.2 * np.arange(ticks)[:, None] + np.arange(of.dof))
    options = {"control": "effort", "compensate": "none", "ground": False, "workers": 0, **options}
    with Runner(of, 1, **options) as runner:
        return runner.rollout(efforts).qpos


@pytest.mark.parametrize("physics", ["accurate", "fast"])
@pytest.mark.parametrize("seed", [0, 3])
def test_motion_of_random_trees_is_that_of_all_links(seed, physics, tmp_path):
    tree = load(tmp_path, robot(*random_tree(np.random.default_rng(seed), 9)))
    ours, theirs = (
        motion(tree, physics=physics, wrenches=links) for links in (None, fixed_links(tree))
    )
    assert np.ptp(theirs, axis=0).max() > 0.1
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-4)


@pytest.mark.parametrize("tool", [INERTIAL + BOX, BOX, BOX + CAPSULE, ""])
def test_mass_is_that_of_all_links(tool, tmp_path):
    loaded = load(tmp_path, arm(tool))
    ours = loaded.mass_matrix([0.3, -0.4])
    theirs = ts.mass_matrix(link_tree(loaded), np.array([0.3, -0.4]))
    np.testing.assert_allclose(ours[0], theirs, atol=2e-5)  # links of 1e-6 kg


@pytest.mark.parametrize("name", ["camera", "bracket", "lower"])
def test_payload_acts_at_the_link_that_carries_it(name, tmp_path):
    drawn = Randomization(payload=Uniform(1.5, 1.5), payload_link=name)
    loaded = load(tmp_path, arm())
    ours, none = motion(loaded, randomization=drawn), motion(loaded)
    theirs = motion(loaded, randomization=drawn, wrenches=fixed_links(loaded))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-4)
    assert np.abs(ours - none).max() > 1e-3


PAIRS = [("arm", "side"), ("tip", "side"), ("arm", "back"), ("tip", "back"), ("side", "back")]


@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
@pytest.mark.parametrize("left_out", range(5))
def test_exactly_the_pairs_that_an_srdf_disables_do_not_touch(left_out, engine, tmp_path):
    """Of three bodies that overlap, one of two links; each pair of links in turn is left to
    touch, and pushes its bodies apart.
    """
    box = INERTIAL + '<collision><geometry><box size="0.4 0.4 0.4"/></geometry></collision>'
    weld = (
        '<joint name="weld" type="fixed"><parent link="arm"/><child link="tip"/><origin xyz="0 0'
        ' 0.1"/></joint>'
    )
    parts = [
        link("base", INERTIAL),
        link("arm", box),
        link("tip", box),
        weld,
        link("side", box),
        link("back", box),
    ]
    places = {"arm": "0 0 1", "side": "0.05 0 1.03", "back": "0.1 0 1.1"}
    parts += [joint(child, "base", child, origin=origin) for child, origin in places.items()]
    pairs = [pair for pair in PAIRS if pair != PAIRS[left_out]]
    text = "".join(
        f'<disable_collisions link1="{one}" link2="{two}" reason="Default"/>' for one, two in pairs
    )
    write(tmp_path, f'<robot name="r">{text}</robot>', "test.srdf")
    loaded = Robot.load(write(tmp_path, robot(*parts)), self_collision="urdf")
    options = {
        "control": "effort",
        "ground": False,
        "workers": 0,
        "engine": engine,
    }
    with Runner(loaded, 1, **options) as runner:
        qvel = runner.step(np.zeros(3), substeps=1).qvel[0]
    apart = {name for name, speed in zip(places, qvel, strict=True) if speed}
    assert apart == {"arm" if name == "tip" else name for name in PAIRS[left_out]}
