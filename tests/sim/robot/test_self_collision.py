"""Self-collision: which pairs of links do not collide, by an .srdf, the pose at rest and sampled
poses.
"""

from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_urdf import INERTIAL, joint, link, robot, write

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot, Runner
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.geometry.distances import Contacts

BOX = '<collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision>'
SLIDE = '<limit lower="-0.5" upper="0.5" effort="10" velocity="2"/>'


def sliders(*places):
    """Return a robot of boxes of 0.2 m on slides along y from a base in the air, which they do not
    touch.
    """
    parts = [link("base", INERTIAL)]
    for index, place in enumerate(places):
        parts.append(link(f"l{index}", INERTIAL + BOX))
        parts.append(
            joint(f"j{index}", "base", f"l{index}", "prismatic", SLIDE, origin=f"0 {place} 1")
        )
    return robot(*parts)


def reasons(loaded):
    return {(pair.first, pair.second): pair.reason for pair in loaded.self_contact.pairs}


def touches(loaded):
    return bool(loaded.dynamics().in_contact(loaded.start[None])[0])


def test_links_that_overlap_at_rest_do_not_collide(tmp_path):
    path = write(tmp_path, sliders(0.0, 0.1, 0.45))
    assert reasons(Robot.load(path)) == {("l0", "l1"): "Default"}
    assert not touches(Robot.load(path))
    assert reasons(Robot.load(path, self_collision="urdf")) == {}
    assert touches(Robot.load(path, self_collision="urdf"))
    assert len(reasons(Robot.load(path, self_collision="none"))) == 3
    assert not touches(Robot.load(path, self_collision="none"))
    with pytest.raises(InvalidArgumentError, match="self_collision"):
        Robot.load(path, self_collision="srdf")


@pytest.mark.parametrize("gap", [-1e-2, -1e-5, 0.0, 1e-5, 9e-4])
def test_links_that_touch_at_the_start_are_not_pushed_apart(gap, tmp_path):
    """PhysX answers 0.01 mm with a large impulse."""
    loaded = Robot.load(write(tmp_path, sliders(0.0, 0.2 + gap)))
    assert reasons(loaded) == {("l0", "l1"): "Default"}
    with Runner(loaded, 1, engine="sapien", control="effort", workers=0) as runner:
        assert np.abs(runner.step(np.zeros(2)).qvel).max() < 1e-3


def test_links_apart_at_the_start_collide(tmp_path):
    assert reasons(Robot.load(write(tmp_path, sliders(0.0, 0.2011)))) == {}


def test_links_that_touch_in_nearly_every_pose_do_not_collide(tmp_path):
    for gap, expected in (
        (0.01, {("l0", "l1"): "Always"}),
        (0.1, {}),
    ):  # a post, and a beam that slides towards it
        beam = sliders(0.0, -4.1 - gap).split("</link>", 2)[2]
        text = sliders(0.0, -4.1 - gap).replace(beam, beam.replace('"0.2 0.2 0.2"', '"0.2 8 0.2"'))
        text = text.replace('lower="-0.5" upper="0.5"', 'lower="0" upper="0.001"', 1).replace(
            '"-0.5"', '"0"'
        )
        path = write(tmp_path, text)
        assert reasons(Robot.load(path)) == expected, gap


def test_neighbours_are_those_with_a_chain_of_links_without_shape_between_them(tmp_path):
    text = robot(
        link("base", INERTIAL + BOX),
        link("hip", INERTIAL),
        link("leg", INERTIAL + BOX),
        link("foot", INERTIAL + BOX),
        joint("a", "base", "hip"),
        joint("b", "hip", "leg"),
        joint("c", "leg", "foot"),
    )
    assert reasons(Robot.load(write(tmp_path, text))) == {
        ("base", "leg"): "Adjacent",
        ("leg", "foot"): "Adjacent",
    }


def test_an_srdf_disables_and_enables_pairs_whatever_their_reason(tmp_path):
    path = write(tmp_path, sliders(0.0, 0.1, 0.202))
    assert set(reasons(Robot.load(path))) == {("l0", "l1"), ("l1", "l2")}
    write(
        tmp_path,
        robot(
            '<disable_collisions link1="l2" link2="l0" reason="Never"/>',
            '<disable_collisions link1="base" link2="l0"/>',
            '<enable_collisions link1="l1" link2="l0"/>',
            '<disable_collisions link1="l2" link2="l7" reason="Default"/><disable_collisions'
            ' link1="l1" link2="l1"/>',
        ),
        "test.srdf",
    )
    loaded = Robot.load(path)
    assert reasons(loaded) == {("l1", "l2"): "Default", ("l2", "l0"): "Never"}
    assert reasons(Robot.load(path, self_collision="urdf")) == {("l2", "l0"): "Never"}
    assert [finding.code for finding in loaded.check() if finding.severity == "warning"].count(
        "self-collision"
    ) == 2


def test_pairs_that_physx_cannot_hold_collide_in_sapien_alone(tmp_path):
    rng, count = np.random.default_rng(0), 60
    path = write(tmp_path, sliders(*(0.0 for _ in range(count))))
    pairs = [(a, b) for a, b in combinations(range(count), 2) if rng.random() < 0.5]
    lines = (f'<disable_collisions link1="l{a}" link2="l{b}"/>' for a, b in pairs)
    write(tmp_path, robot(*lines), "test.srdf")
    loaded = Robot.load(path, self_collision="urdf")
    assert len(loaded.self_contact.ignored) == len(pairs)
    assert loaded.check(engine="mujoco") == loaded.check()
    left = [found for found in loaded.check(engine="sapien") if found.code == "engine"]
    assert 0 < len(left) < len(pairs)
    assert all("filter of pairs is full" in found.text for found in left)


def test_a_base_that_is_fixed_too_low_has_no_ground(tmp_path):
    high = write(tmp_path, sliders(0.0), "high.urdf")
    low = write(tmp_path, sliders(0.0).replace('0.0 1"', '0.0 0.05"'), "low.urdf")
    assert Robot.load(high).has_ground
    assert not Robot.load(low).has_ground
    assert Robot.load(low, fixed_base=False).has_ground
    with Runner(Robot.load(low), 1, workers=0) as runner:
        assert not runner.options.ground
        assert abs(runner.step([[0.2]]).qpos[0, 0]) < 0.2
    with Runner(Robot.load(low), 1, workers=0, ground=True) as runner:
        assert runner.options.ground


def spec_of(loaded):
    return SceneSpec(
        loaded.tables, loaded.self_contact.ignored, loaded.joints, 1e-3, None, ground=False
    )


@given(st.integers(0, 2**32))
@settings(deadline=None, max_examples=8)
def test_contacts_are_of_all_pairs_but_the_disabled_and_the_neighbours(seed):
    rng = np.random.default_rng(seed)
    parts, body = [link("base", INERTIAL)], {}
    for arm in range(5):  # all at one place, each with a tool; the last on the first
        parent = "arm0" if arm == 4 else "base"
        for name, other, kind in (
            (f"arm{arm}", parent, "prismatic"),
            (f"tool{arm}", f"arm{arm}", "fixed"),
        ):
            parts += [
                link(name, INERTIAL + BOX),
                joint(name, other, name, kind, SLIDE, origin="0 0 0"),
            ]
            body[name] = f"arm{arm}"
    pairs = list(combinations(body, 2))
    disabled = [pair for pair in pairs if rng.random() < rng.uniform(0, 1)]
    with TemporaryDirectory() as folder:
        path = write(Path(folder), robot(*parts))
        lines = (f'<disable_collisions link1="{a}" link2="{b}"/>' for a, b in disabled)
        write(Path(folder), robot(*lines), "test.srdf")
        loaded = Robot.load(path, self_collision="urdf")
        spec = spec_of(loaded)
        ignored = {frozenset(pair) for pair in spec.ignored}
        contacts = Contacts(spec.rigid_tree, spec.simulated.shapes, ignored, False)
        near = contacts.near(loaded.start, 0.02)
        seen = {frozenset((first, second)) for first, second, _ in near}
    far = {pair for pair in map(frozenset, pairs) if len({body[name] for name in pair}) == 2}
    neighbours = {frozenset((a, b)) for a, b in pairs if {body[a], body[b]} == {"arm0", "arm4"}}
    assert set(seen) - neighbours == far - neighbours - set(map(frozenset, disabled))
