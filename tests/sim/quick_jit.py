"""Compilation by JAX in a third of the time, for tests of results, not of speed."""

import functools

import jax

_OPTIONS = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


def _is_known(name):
    """Return whether this version of XLA has an option."""
    try:
        jax.jit(lambda x: x + 1, compiler_options={name: _OPTIONS[name]})(0.0)
    except jax.errors.JaxRuntimeError:
        return False
    return True


@functools.cache
def _known_options():
    return {name: value for name, value in _OPTIONS.items() if _is_known(name)}


def quick_jit(function, **options):
    """Return ``function`` compiled by :func:`jax.jit` with few optimisations."""
    return jax.jit(function, compiler_options=_known_options(), **options)
