"""Fixtures of the law: options, backends, inputs."""

from typing import Any

import jax
import numpy as np
import pytest
from law_cases import ENVS, JOINTS, OPTIONS, Backend, Inputs, read_only
from quick_jit import quick_jit

import batchpid as bp

COMPILED_BY_DEFAULT = ("limits", "mixed per env", "everything")


@pytest.fixture(autouse=True)
def strict() -> Any:
    """Trace the pure functions under JAX's strict modes in every test."""
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(params=OPTIONS, ids=str)
def options(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Arguments of make_params, with every option on in some case."""
    return dict(OPTIONS[request.param])


@pytest.fixture
def x64() -> Any:
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.fixture(params=["numpy64", "numpy32", "jax64", "jax32"])
def backend(request: pytest.FixtureRequest) -> Backend:
    """NumPy on read-only arrays, and JAX compiled under its strict modes, in both float types."""
    dtype = np.float64 if request.param.endswith("64") else np.float32
    if request.param.startswith("numpy"):
        return Backend(request.param, dtype, lambda value: read_only(value, dtype), bp.step_terms)
    if dtype == np.float64:
        request.getfixturevalue("x64")
    # Options that work together, as JAX compiles them by default; the others in a third of the time.
    default = request.node.callspec.params["options"] in COMPILED_BY_DEFAULT and dtype == np.float64
    step = (jax.jit if default else quick_jit)(bp.step_terms, static_argnames="dt")

    def strict_step(*args: Any, **keywords: Any) -> Any:
        with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
            return step(*args, **keywords)

    return Backend(request.param, dtype, lambda value: jax.numpy.asarray(value, dtype=dtype), strict_step)


@pytest.fixture
def inputs() -> Inputs:
    """Thirty steps that saturate, wrap and reverse; float32 numbers, so that every backend gets the same."""
    rng = np.random.default_rng(7)
    steps = np.arange(30)[:, None, None]
    phase = rng.uniform(0, 6, (1, ENVS, JOINTS))
    measurement = 3 * np.sin(0.15 * steps + phase) + 0.3 * steps
    setpoint = np.where(steps < 12, 1.0, -2.0) * np.cos(phase) + 0.01 * steps
    noise = [rng.normal(size=measurement.shape) for _ in range(3)]
    return Inputs(*(np.asarray(x, np.float32).astype(float) for x in (setpoint, measurement, *noise)))
