"""Collision groups: any graph of pairs to ignore becomes words of PhysX's filter."""

from itertools import combinations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from physx_filter import may_touch

from batchpid.sim.engine.sapien.limits import collision_groups
from batchpid.sim.engine.sapien.user_content import HeadlessScene, sapien

DEFAULT = (1, 1, 0, 0)


def graphs(largest, density):
    """Return a strategy of graphs: the bodies, the pairs to ignore and the pairs that may be
    either.
    """

    @st.composite
    def draw_graph(draw):
        bodies = [f"b{n}" for n in range(draw(st.integers(1, largest)))]
        rng = np.random.default_rng(draw(st.integers(0, 2**32)))
        share = draw(st.floats(0, density))
        pairs = [frozenset(pair) for pair in combinations(bodies, 2)]
        return (
            bodies,
            {p for p in pairs if rng.random() < share},
            {p for p in pairs if rng.random() < 0.1},
        )

    return draw_graph()


def check(bodies, ignored, free):
    """Check the words of a graph; return the pairs that are left over."""
    groups, left_over = collision_groups(bodies, ignored, free)
    assert left_over <= ignored
    for first, second in combinations(bodies, 2):
        pair, touch = frozenset((first, second)), may_touch(groups[first], groups[second])
        if pair in ignored:
            assert touch == (pair in left_over)
        elif pair not in free:
            assert touch
    assert all(may_touch(words, DEFAULT) for words in groups.values())
    return left_over


@given(graphs(80, 0.3))
@settings(max_examples=15, deadline=None)
def test_no_pair_is_ignored_that_should_touch_however_large_the_graph(graph):
    check(*graph)


@given(st.integers(2, 120), st.integers(0, 2**32))
@settings(max_examples=15, deadline=None)
def test_any_32_pairs_are_represented_however_many_bodies(count, seed):
    bodies, rng = [f"b{n}" for n in range(count)], np.random.default_rng(seed)
    assert not check(
        bodies, {frozenset(rng.choice(bodies, 2, replace=False)) for _ in range(32)}, set()
    )


@given(graphs(7, 1.0), st.integers(0, 2**32))
@settings(max_examples=10, deadline=None)
def test_physx_reports_the_contacts_that_the_words_say(graph, seed):
    bodies, ignored, _ = graph
    words, _ = collision_groups(bodies, ignored)
    words |= {"content": DEFAULT}
    scene = HeadlessScene()
    rng = np.random.default_rng(seed)
    names = {}
    for name, groups in words.items():
        builder = scene.create_actor_builder()
        builder.add_sphere_collision(radius=1.0)
        builder.collision_groups = list(groups)
        builder.set_initial_pose(sapien.Pose(rng.uniform(-0.1, 0.1, 3)))
        names[builder.build(name=name)] = name
    scene.step()
    seen = {
        frozenset(names[body.entity] for body in contact.bodies) for contact in scene.get_contacts()
    }
    assert seen == {
        frozenset(pair)
        for pair in combinations(words, 2)
        if may_touch(words[pair[0]], words[pair[1]])
    }
