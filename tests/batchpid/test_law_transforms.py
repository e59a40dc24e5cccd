"""The law under every JAX transform; test_law_conformance.py compares the compiled law with
NumPy's.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_programs import RESET
from law_cases import DT, JOINTS, OPTIONS, Inputs, by_steps
from quick_jit import quick_jit

import batchpid as bp

GAINS = ("kp", "ki", "kd")
QUICK = ("mixed per env", "filter", "setpoint weight")
GRADIENTS = [
    case if case in QUICK else pytest.param(case, marks=pytest.mark.slow) for case in OPTIONS
]


def on_jax(tree):
    return jax.tree.map(jnp.asarray, tree)


def rollout(params, setpoint, measurement):
    """Return all efforts of a scan over time."""

    def body(state, inputs):
        return bp.step(params, state, *inputs, DT)

    return jax.lax.scan(body, bp.init(params, measurement[0]), (setpoint, measurement))[1]


def test_functions_of_one_robot(inputs, x64):
    """Arrays (joints,) in, arrays (joints,) out: under vmap."""
    params = bp.make_params(JOINTS, kp=40.0, ki=5.0, kd=2.0, effort_limit=9.0, setpoint_weight=0.7)
    run = Inputs(*(rows[:RESET] for rows in inputs[:2]))
    expected = by_steps(params, run)

    def last_state(setpoint, measurement):
        state = bp.init(params, measurement[0])
        return jax.lax.scan(
            lambda state, now: bp.step(params, state, *now, DT), state, (setpoint, measurement)
        )

    def kept(state, mask):
        return bp.reset(params, state, state.origin, mask)

    mask = jnp.zeros(4, bool)
    state, efforts = jax.vmap(last_state, 1, (0, 1))(*run[:2])
    again = jax.vmap(kept)(state, mask)
    np.testing.assert_allclose(efforts, expected, rtol=1e-12, atol=1e-11)
    assert isinstance(state, bp.PIDState)
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), again, state))


@pytest.mark.parametrize("options", GRADIENTS, indirect=True)
def test_gradients_equal_finite_differences(options, inputs, x64):
    """Gradients through a scan are those of the law in NumPy. Away from saturation: the made-up run
    is scaled down, so that no limit is near.
    """
    options.pop("effort_rate_limit", None)
    params = bp.make_params(JOINTS, **options)
    if params.effort_min is not None:
        params = params._replace(
            effort_min=100 * params.effort_min, effort_max=100 * params.effort_max
        )
    if params.deadband is not None:
        params = params._replace(deadband=1e-3 * params.deadband)
    run = Inputs(*(1e-3 * rows[:RESET] for rows in inputs[:2]))
    weights = inputs.feedforward[:RESET]

    @quick_jit
    @jax.grad
    def gradient_of(params):
        return jnp.sum(weights * rollout(params, *map(jnp.asarray, run[:2])))

    gradient = gradient_of(on_jax(params))
    assert jax.tree.structure(gradient) == jax.tree.structure(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    h, rng = 1e-4, np.random.default_rng(0)
    for name in GAINS:
        if (value := getattr(params, name)) is None:
            continue
        shift = rng.normal(size=value.shape)
        up, down = (
            np.sum(weights * by_steps(params._replace(**{name: value + s * h * shift}), run))
            for s in (1, -1)
        )
        slope = np.sum(getattr(gradient, name) * shift)
        np.testing.assert_allclose(slope, (up - down) / (2 * h), rtol=1e-6, atol=1e-9)
        assert slope != 0


TIMES = [0.0, 0.0, 0.1]


@pytest.mark.parametrize(
    "options",
    [
        {"derivative_filter_time": TIMES},
        {"tracking_time": TIMES, "anti_windup": "back_calculation"},
    ],
)
def test_gradients_survive_times_of_zero(options, inputs, x64):
    params = on_jax(bp.make_params(JOINTS, 40, 5, 2, effort_limit=1.0, **options))
    r, y = map(jnp.asarray, inputs[:2])
    gradients = quick_jit(jax.grad(lambda params: jnp.sum(rollout(params, r, y))))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


@pytest.mark.parametrize("build", ["make_params", "replace"])
def test_gains_may_be_traced_through_make_params_and_replace(build, inputs, x64):
    """The gradient through both is that through the leaves, compiled and vectorised."""
    options = {"ki": 5.0, "kd": [0.0, 2.0, 1.0], "effort_limit": 90.0, "anti_windup": "conditional"}
    r, y = jnp.asarray(inputs.setpoint), jnp.asarray(inputs.measurement)
    base = bp.make_params(JOINTS, 40.0, **options)

    def built(kp):
        return (
            bp.make_params(JOINTS, kp, **options) if build == "make_params" else base.replace(kp=kp)
        )

    def cost(kp):
        return jnp.mean(rollout(built(kp), r, y) ** 2)

    def cost_of_leaf(kp):
        return jnp.mean(rollout(base._replace(kp=kp[None]), r, y) ** 2)

    kp = jnp.array([40.0, 20.0, 0.5])
    slopes = quick_jit(jax.vmap(jax.grad(cost)))(jnp.stack([kp, kp]))
    np.testing.assert_allclose(slopes[1], quick_jit(jax.grad(cost_of_leaf))(kp), rtol=1e-9)
    assert (slopes != 0).all()
    assert jax.vmap(built)(jnp.stack([kp, 2 * kp])).kp.tolist() == [
        [kp.tolist()],
        [(2 * kp).tolist()],
    ]


def test_traced_gains_have_their_shapes_checked_and_give_the_params_their_dtype():
    def gains(kp, **options):
        return jax.eval_shape(lambda kp: bp.make_params(2, kp, **options), kp)

    assert gains(jnp.ones(2), ki=1.0).dtype == np.float32
    assert gains(jnp.ones(2, int)).dtype == np.float32
    assert gains(jnp.ones((5, 1)), deadband=0.1).kp.shape == (5, 2)
    with pytest.raises(bp.InvalidArgumentError, match=r"kp: has shape \(3,\), not"):
        gains(jnp.ones(3))
    with pytest.raises(bp.InvalidArgumentError, match=r"kd: has shape \(4, 2\), not \(5, 2\)"):
        gains(jnp.ones((5, 2)), kd=np.ones((4, 2)))
    with pytest.raises(
        bp.InvalidArgumentError,
        match="kp: cannot be read as an array of numbers: its dtype is bool",
    ):
        gains(jnp.ones(2, bool))


def test_an_option_that_is_traced_is_on():
    def build(value):
        params = bp.make_params(
            2, 1.0, deadband=value, effort_limit=value, derivative_filter_time=value, kd=1.0
        )
        return [leaf is None for leaf in params]

    traced = []
    jax.jit(lambda value: traced.append(build(value)))(0.0)
    assert traced == [build(0.5)]


def test_numpy_and_traced_arguments_may_be_mixed(inputs, x64):
    """Each of params, state and inputs may be NumPy while another is traced."""
    params = bp.make_params(
        JOINTS, 40.0, 5.0, 2.0, effort_limit=9.0, anti_windup="back_calculation"
    )
    r, y = inputs.setpoint[0], inputs.measurement[0]
    state = bp.init(params, y)
    expected = bp.step(params, state, r, y + 0.1, DT)[1]
    for traced in range(4):
        arguments = [params, state, r, y + 0.1]

        def step(argument, traced=traced, arguments=arguments):
            return bp.step(*arguments[:traced], argument, *arguments[traced + 1 :], DT)[1]

        np.testing.assert_allclose(jax.jit(step)(arguments[traced]), expected, rtol=1e-12)
