"""Fixtures of the law: options, inputs, JAX's modes."""

import jax
import pytest
from law_cases import OPTIONS, made_up_inputs

# Before JAX begins: tests of programs on several devices.
jax.config.update("jax_num_cpu_devices", 4)


@pytest.fixture(autouse=True)
def strict():
    """Trace the pure functions under JAX's strict modes in every test."""
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(params=OPTIONS, ids=str)
def options(request):
    """Arguments of make_params, with every option on in some case."""
    return dict(OPTIONS[request.param])


@pytest.fixture
def x64():
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.fixture
def inputs():
    return made_up_inputs()
