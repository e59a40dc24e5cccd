"""Programs of the stages of actuators give what NumPy gives, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import batchpid as bp
from batchpid.motors import STAGES, advance_effort, advance_measurement, discretise
from batchpid.native import compiled as module
from batchpid.native.availability import SWITCH, obstacle
from batchpid.native.compiled import compiled_stages

DT, SHAPE = 1 / 2000, (3, 4)
needs_extension = pytest.mark.skipif(bool(obstacle()), reason="there is no extension")
EFFECTS = {
    "command_delay": 0.0033,
    "sensor_delay": 0.0021,
    "lag": 0.004,
    "strength": 0.9,
    "bias": 0.1,
    "effort_limit": 40.0,
    "position_offset": 0.1,
    "backlash": 0.1,
    "position_resolution": 1e-2,
    "velocity_resolution": 1e-2,
    "position_noise": 1e-2,
    "velocity_noise": 1e-2,
    "envelope": (60.0, 2.0),
    "position_limit": ([-1.0, 0.0, 1.0], [20.0, 50.0, 30.0]),
    "continuous": [True, False, True, False],
}


def built(names, rng):
    """Return actuators with the effects ``names``; numbers of envs and joints differ."""
    options = {name: value for name, value in EFFECTS.items() if name in names}
    if "envelope" in options:
        options["saturation_effort"], options["no_load_speed"] = options.pop("envelope")
    for name, value in options.items():
        if isinstance(value, float) and rng.random() < 0.5:
            options[name] = value * rng.uniform(0.0 if "delay" in name else 0.5, 1.0, SHAPE)
    actuators = bp.make_actuators(SHAPE[1], **options, seed=1)
    if rng.random() < 0.5:  # draws need not be contiguous
        resolution = actuators.position_resolution
        turned = None if resolution is None else np.asfortranarray(np.broadcast_to(resolution, SHAPE))
        actuators = actuators._replace(position_resolution=turned)
    return actuators


@needs_extension
@given(st.sets(st.sampled_from(sorted(EFFECTS))), st.integers(0, 100))
def test_programs_of_actuators_are_bit_identical_with_numpy(names, seed):
    rng = np.random.default_rng(seed)
    actuators = built(names, np.random.default_rng(seed))
    first = bp.motors.init(actuators, rng.normal(size=SHAPE), DT)
    k = discretise(actuators, first, DT, SHAPE[0])
    both = {compiled_stages(k, SHAPE): first, STAGES: first}
    for _ in range(12):
        qpos, qvel, effort = rng.normal(size=SHAPE), 3 * rng.normal(size=SHAPE), 80 * rng.normal(size=SHAPE)
        effort[0, 0] = rng.choice([effort[0, 0], np.nan, np.inf, -0.0])
        found = []
        for stages, state in both.items():
            state, *measured = advance_measurement(k, state, qpos, qvel, stages=stages)
            with np.errstate(invalid="ignore"):
                both[stages], delivered = advance_effort(k, state, effort, qpos, qvel, stages)
            found.append([*measured, *stages.limits(k, *measured), delivered, *both[stages].leaves().values()])
        for ours, expected in zip(*found, strict=True):
            assert (ours is None) == (expected is None)
            if ours is not None:
                np.testing.assert_array_equal(ours, expected)


@needs_extension
def test_programs_run_where_they_are_faster_and_only_with_their_coefficients():
    qpos = np.zeros(SHAPE)
    many = built(EFFECTS.keys(), np.random.default_rng(0))
    state = bp.motors.init(many, qpos, DT)
    k = discretise(many, state, DT, SHAPE[0])
    for stage, inputs in (("delivered", 4), ("limits", 2), ("play", 3)):
        assert module._program(getattr(STAGES, stage), k, SHAPE, (False,) * inputs) is not None, stage
    stages = compiled_stages(k, SHAPE)
    stronger = discretise(bp.make_actuators(SHAPE[1], strength=2.0), state, DT, SHAPE[0])
    np.testing.assert_array_equal(stages.delivered(stronger, qpos, qpos + 1.0, qpos, qpos)[0], 2.0)


def test_without_the_extension_stages_are_numpys(monkeypatch):
    monkeypatch.setenv(SWITCH, "0")
    actuators = bp.make_actuators(SHAPE[1], strength=0.5)
    k = discretise(actuators, bp.motors.init(actuators, np.zeros(SHAPE), DT), DT, SHAPE[0])
    assert compiled_stages(k, SHAPE) is STAGES
