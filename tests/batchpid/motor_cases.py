"""Options of motors that tests share: every effect at once, and random ones."""

from __future__ import annotations

ALL = {
    "command_delay": 0.0017,
    "sensor_delay": [[0.0008, 0.002, 0.0, 0.0013]],
    "lag": 0.003,
    "strength": 0.9,
    "bias": 0.1,
    "saturation_effort": 8.0,
    "no_load_speed": 4.0,
    "effort_limit": 6.0,
    "position_offset": 0.03,
    "backlash": 0.01,
    "position_noise": 1e-3,
    "velocity_noise": 1e-2,
    "continuous": [True, False, False, True],
    "seed": 3,
}


def random_options(rng, envs, joints):
    """Return arguments of make_actuators for some random effects, over many decades."""
    scales = {
        "command_delay": 0.01,
        "sensor_delay": 0.01,
        "lag": 0.01,
        "strength": 1,
        "bias": 1,
        "effort_limit": 30,
    }
    scales |= {
        "saturation_effort": 50,
        "no_load_speed": 3,
        "backlash": 0.01,
        "coulomb": 0.3,
        "viscous": 1,
    }
    scales |= {
        "armature": 0.1,
        "position_resolution": 1e-3,
        "velocity_resolution": 1e-2,
        "position_noise": 1e-3,
    }
    scales |= {"velocity_noise": 1e-2}
    chosen = {name for name in scales if rng.random() < 0.5}
    chosen |= {"saturation_effort", "no_load_speed"} if "no_load_speed" in chosen else set()
    chosen -= {"saturation_effort"} if "no_load_speed" not in chosen else set()
    shapes = [(), (joints,), (envs, joints)]
    return {
        name: scales[name] * 10.0 ** rng.uniform(-2, 0.5, shapes[rng.integers(3)])
        for name in sorted(chosen)
    }
