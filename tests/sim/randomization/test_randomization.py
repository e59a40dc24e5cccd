"""Randomization: draws depend on seed, env, episode and field alone, and results are in range."""

import hashlib
from types import MappingProxyType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import load_bundled

from batchpid import make_actuators
from batchpid.errors import InvalidArgumentError
from batchpid.sim import LogUniform, Normal, Randomization, Robot, Uniform
from batchpid.sim.randomization.checks import check_params, check_robot, prepared_actuators
from batchpid.sim.randomization.distributions import NOTHING, elements

PANDA = load_bundled("panda")
FIELDS = {
    "payload": Uniform(0, 2),
    "link_mass": Uniform(0.8, 1.2, operation="scale"),
    "center_of_mass": Uniform(-0.01, 0.01),
    "friction": {"panda_joint1": LogUniform(0.1, 1.0), "panda_joint4": Normal(0.5, 0.1)},
    "armature": Uniform(0.0, 0.1, shared=True),
    "qpos": Uniform(-0.1, 0.1),
    "params": {"kp": LogUniform(0.5, 2.0, operation="scale")},
    "actuators": {"command_delay": Uniform(0, 0.005, shared=True)},
}
READ_ONLY = {"params": MappingProxyType(FIELDS["params"])}
counts = st.integers(0, 2**63 - 1)
episodes = st.lists(st.tuples(counts, counts), min_size=1, max_size=5)


def drawn(randomization, rows):
    return randomization.draw(PANDA, np.array(rows, np.int64)).values


@settings(max_examples=12)
@given(rows=episodes, seed=counts, order=st.randoms())
def test_an_env_draws_the_same_in_any_company(rows, seed, order):
    randomization, shuffled = (
        Randomization(seed=seed, **FIELDS),
        order.sample(range(len(rows)), len(rows)),
    )
    together, alone = drawn(randomization, rows), [drawn(randomization, [row]) for row in rows]
    mixed = drawn(randomization, [rows[row] for row in shuffled])
    for name, values in together.items():
        np.testing.assert_array_equal(values, np.concatenate([each[name] for each in alone]), name)
        np.testing.assert_array_equal(values[shuffled], mixed[name], name)


@settings(max_examples=12)
@given(names=st.sets(st.sampled_from(sorted(FIELDS)), min_size=1), seed=counts)
def test_a_field_draws_the_same_with_any_other_fields(names, seed):
    rows = [(0, 0), (3, 7)]
    everything = drawn(Randomization(seed=seed, **FIELDS), rows)
    some = drawn(Randomization(seed=seed, **{name: FIELDS[name] for name in names}), rows)
    assert some
    for name, values in some.items():
        np.testing.assert_array_equal(values, everything[name], name)


def test_draws_are_those_of_philox_with_the_documented_key_and_counter():
    randomization = Randomization(seed=5, qpos=Uniform(-1, 1))
    key = [5, int.from_bytes(hashlib.blake2b(b"qpos", digest_size=8).digest(), "little")]
    for stream, episode in ((0, 0), (7, 2)):
        generator = np.random.Generator(np.random.Philox(key=key, counter=[0, 0, episode, stream]))
        expected = generator.uniform(-1, 1, PANDA.dof)
        np.testing.assert_array_equal(
            drawn(randomization, [(stream, episode)])["qpos"][0], expected
        )


def test_seeds_streams_episodes_and_fields_are_independent():
    randomization = Randomization(
        payload=Uniform(0, 1), friction=Uniform(0, 1), damping=Uniform(0, 1)
    )
    rows = [(stream, episode) for stream in range(40) for episode in range(40)]
    values = drawn(randomization, rows)
    table = np.column_stack([values["payload"], values["friction"], values["damping"]])
    assert len(np.unique(table)) == table.size
    correlation = np.corrcoef(table.T) - np.eye(table.shape[1])
    assert np.abs(correlation).max() < 5 / np.sqrt(len(rows))
    np.testing.assert_allclose(table.mean(0), 0.5, atol=0.03)
    np.testing.assert_allclose(table.std(0), 1 / np.sqrt(12), rtol=0.08)
    other = drawn(Randomization(seed=1, payload=Uniform(0, 1)), rows)["payload"]
    assert abs(np.corrcoef(other[:, 0], values["payload"][:, 0])[0, 1]) < 0.1


def test_shared_and_named_draws():
    values = drawn(Randomization(**FIELDS), [(env, 0) for env in range(20)])
    assert (np.ptp(values["actuators.command_delay"], axis=1) == 0).all()
    assert (np.ptp(values["link_mass"], axis=1) > 0).all()
    named = ~np.isnan(values["friction"]).all(0)
    assert [PANDA.joint_names[joint] for joint in np.flatnonzero(named)] == [
        "panda_joint1",
        "panda_joint4",
    ]
    assert values["payload"].shape == (20, 1)


def test_what_is_drawn_once_for_each_env_does_not_depend_on_the_episode():
    values = drawn(Randomization(per="env", **FIELDS), [(2, 0), (2, 9), (3, 0)])
    for name, rows in values.items():
        np.testing.assert_array_equal(rows[0], rows[1], name)
    assert values["payload"][0] != values["payload"][2]


def test_draws_are_applied_by_their_operation():
    randomization = Randomization(**FIELDS)
    draws = randomization.redraw(PANDA, NOTHING, np.ones(3, bool), 0)
    params = PANDA.params()
    varied = randomization.randomized("params", params, draws, PANDA)
    np.testing.assert_array_equal(varied.kp, params.kp * draws.values["params.kp"])
    assert varied.ki is params.ki
    assert Randomization().randomized("params", params, draws, PANDA) is params
    ideal = prepared_actuators(randomization, None, PANDA)
    assert ideal.max_delay == 0.005
    actuators = randomization.randomized("actuators", ideal, draws, PANDA)
    np.testing.assert_array_equal(actuators.command_delay, draws.values["actuators.command_delay"])
    late = prepared_actuators(randomization, make_actuators(PANDA.dof, command_delay=0.001), PANDA)
    later = randomization.randomized("actuators", late, draws, PANDA)
    assert late.max_delay == 0.006
    np.testing.assert_array_equal(later.command_delay, 0.001 + actuators.command_delay)
    start = np.tile(PANDA.upper, (3, 1))
    qpos, qvel = randomization.start(start, np.zeros_like(start), draws, PANDA)
    np.testing.assert_array_equal(
        qpos, np.clip(start + draws.values["qpos"], PANDA.lower, PANDA.upper)
    )
    assert not qvel.any()


def test_centers_of_mass_are_drawn_along_three_axes():
    """For all links, or those that are named."""
    one = Randomization(center_of_mass={"panda_link7": Uniform(-0.01, 0.01)})
    check_robot(one, PANDA)
    columns, rows = (
        elements("center_of_mass", PANDA),
        drawn(one, [(env, 0) for env in range(9)])["center_of_mass"],
    )
    named = [columns[at] for at in np.flatnonzero(~np.isnan(rows).all(0))]
    assert named == ["panda_link7.x", "panda_link7.y", "panda_link7.z"]
    assert len(np.unique(rows[:, ~np.isnan(rows).all(0)])) == 27
    everywhere = drawn(Randomization(center_of_mass=Uniform(-0.01, 0.01)), [(0, 0)])[
        "center_of_mass"
    ]
    assert everywhere.shape == (1, 3 * len(elements("link_mass", PANDA)))


def test_static_friction_may_be_drawn_below_coulombs():
    """The model takes the larger one."""
    drawn_static = Randomization(actuators={"static": Uniform(0, 2, operation="abs")})
    check_robot(drawn_static, PANDA)
    worn = make_actuators(PANDA.dof, coulomb=1.0)
    prepared = prepared_actuators(drawn_static, worn, PANDA)
    draws = drawn_static.redraw(PANDA, NOTHING, np.ones(50, bool), 0)
    rows = drawn_static.randomized("actuators", prepared, draws, PANDA)
    assert rows.static.min() < 1.0 < rows.static.max()
    assert rows.coulomb.tolist() == worn.coulomb.tolist()


def test_it_is_what_a_file_describes():
    described = {
        "seed": 3,
        "per": "env",
        "payload_link": "panda_hand",
        "payload": {"uniform": [0, 2]},
        "friction": {"panda_joint1": {"normal": [0.5, 0.1]}},
        "params": {"kp": {"log_uniform": [0.5, 2.0], "operation": "scale", "shared": True}},
    }
    assert Randomization.from_dict(described) == Randomization(
        seed=3,
        per="env",
        payload_link="panda_hand",
        payload=Uniform(0, 2),
        friction={"panda_joint1": Normal(0.5, 0.1)},
        params={"kp": LogUniform(0.5, 2.0, operation="scale", shared=True)},
    )
    assert Randomization(**FIELDS) == Randomization(**MappingProxyType(FIELDS | READ_ONLY))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"payload": Uniform(-1, 1)},
            r"payload, entry 'payload': must be finite and >= 0 \(got -1",
        ),
        ({"payload": Uniform(0, 1, operation="scale")}, "payload: is 0, which cannot be scaled"),
        ({"payload": Uniform(0, 1), "payload_link": "wheel"}, "payload_link: unknown option"),
        (
            {"link_mass": Normal(1, 0.3, operation="scale")},
            r"link_mass, entry .*: must be finite and > 0",
        ),
        ({"link_mass": {"wheel": Uniform(0, 1)}}, "link_mass: unknown option"),
        ({"center_of_mass": {"wheel": Uniform(0, 1)}}, "center_of_mass: unknown option"),
        (
            {"center_of_mass": Uniform(0, 1, operation="scale")},
            "center_of_mass: is 0, which cannot be scaled",
        ),
        ({"friction": {"panda_joint9": Uniform(0, 1)}}, "friction: unknown option"),
        ({"damping": Uniform(-0.1, 0.1)}, r"damping, entry 'panda_joint1': must be .*got -0\.097"),
        ({"params": {"kq": Uniform(0, 1)}}, "params.kq: is off"),
        ({"params": {"kp": Normal(0, 100)}}, "params.kp, joint 'panda_joint1'"),
        ({"actuators": {"delay": Uniform(0, 1)}}, "actuators: unknown option"),
        ({"actuators": {"command_delay": Uniform(0, 2)}}, "command_delay, joint .*: out of range"),
        ({"actuators": {"effort_limit": Uniform(0, 2)}}, "actuators.effort_limit: is off"),
        ({"payload": 0.5}, "payload: must be of type Distribution"),
        ({"friction": {}}, "friction: must be of type Distribution"),
        ({"params": Uniform(0, 1)}, "params: is not a mapping"),
        ({"seed": -1}, "seed: out of range"),
        ({"per": "tick"}, "per: unknown option"),
    ],
)
def test_what_does_not_fit_is_refused(fields, message):
    def check():
        randomization = Randomization(**fields)
        check_robot(randomization, PANDA)
        check_params(randomization, PANDA.params(), PANDA)
        prepared_actuators(randomization, None, PANDA)

    with pytest.raises(InvalidArgumentError, match=message):
        check()


def test_damping_that_the_engine_simulates_is_not_drawn():
    with pytest.raises(InvalidArgumentError, match="damping: cannot be drawn: the engine sets it"):
        check_robot(Randomization(damping=Uniform(0, 1)), Robot.load("panda", dissipation="sapien"))


@pytest.mark.parametrize(
    ("known", "message"),
    [
        ({"load": {"uniform": [0, 1]}}, "randomization: unknown option"),
        ([1], "randomization: is not a mapping"),
        ({"params": {"kp": {"uniform": [2, 1]}}}, "params.kp: high: out of range"),
        (
            {"friction": {"panda_joint1": {"normal": [0]}}},
            "friction.panda_joint1: is not a distribution",
        ),
    ],
)
def test_a_file_that_describes_none_is_refused(known, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Randomization.from_dict(known)
