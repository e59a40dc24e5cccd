"""Cases that the tests of the law share: every option, array libraries, a made-up run."""

import math
from typing import Any, NamedTuple

import numpy as np

JOINTS, ENVS, DT = 3, 4, 0.01

GAINS = {"kp": [40.0, 20.0, 0.5], "ki": [5.0, 50.0, 0.0], "kd": [2.0, 0.3, 0.02]}
LIMITED = GAINS | {"effort_limit": [30.0, 8.0, 1.0]}
OPTIONS: dict[str, dict[str, Any]] = {
    "p": {"kp": 3.0},
    "pd": {"kp": 3.0, "kd": 0.4},
    "pid": GAINS,
    "per env": {"kp": np.linspace(1, 9, ENVS * JOINTS).reshape(ENVS, JOINTS), "ki": 2.0, "kd": 0.1},
    "limits": LIMITED,
    "one limit": GAINS | {"effort_max": 3.0},
    "rate limit": GAINS | {"effort_rate_limit": 400.0},
    "rate and limits": LIMITED | {"effort_rate_limit": [400.0, 100.0, 9.0]},
    "integral limit": GAINS | {"integral_limit": 0.2},
    "filter": GAINS | {"derivative_filter_time": [0.0, 0.02, 0.005]},
    "setpoint weight": GAINS | {"setpoint_weight": [0.0, 0.7, 1.0]},
    "derivative weight": (
        GAINS | {"setpoint_weight_derivative": [1.0, 0.3, 0.0], "derivative_filter_time": 0.02}
    ),
    "deadband": GAINS | {"deadband": [0.0, 0.3, 1.0]},
    "clamp": LIMITED | {"anti_windup": "clamp"},
    "conditional": LIMITED | {"anti_windup": "conditional"},
    "back calculation": (
        LIMITED | {"anti_windup": "back_calculation", "tracking_time": [0.1, 0.001, 0.0]}
    ),
    "mixed": LIMITED | {"anti_windup": ["back_calculation", "conditional", "clamp"]},
    "mixed per env": (
        LIMITED
        | {
            "anti_windup": [
                ["none", "conditional", "clamp"],
                *[["back_calculation", "conditional", "none"]] * (ENVS - 1),
            ]
        }
    ),
    "continuous": GAINS | {"continuous": [True, False, True]},
    "zero effort": LIMITED | {"non_finite": "zero"},
    "hold effort": LIMITED | {"non_finite": "hold"},
    "everything": (
        LIMITED
        | {
            "effort_rate_limit": 1000.0,
            "integral_limit": 4.0,
            "derivative_filter_time": 0.02,
            "setpoint_weight": 0.7,
            "setpoint_weight_derivative": 0.2,
            "deadband": 0.05,
            "anti_windup": ["back_calculation", "conditional", "clamp"],
            "continuous": [True, False, True],
            "non_finite": "hold",
        }
    ),
}

NUMBERS = {
    "ki": (0.0, 50.0),
    "kd": (0.0, 2.0),
    "effort_rate_limit": (math.inf, 900.0),
    "derivative_filter_time": (0.0, 0.05),
    "setpoint_weight": (1.0, 0.9),
    "setpoint_weight_derivative": (0.0, 0.9),
    "deadband": (0.0, 0.5),
    "effort_min": (-math.inf, -30.0),
    "effort_max": (math.inf, 30.0),
    "integral_min": (-math.inf, -4.0),
    "integral_max": (math.inf, 4.0),
}
"""Options that are numbers: the value that is off, and one that has an effect."""
NAMES = {
    "non_finite": ("propagate", "zero", "hold"),
}


def generated_options(seed: int, envs: int = ENVS) -> dict[str, Any]:
    """Return arguments of make_params of any combination, with an entry for each env and joint,
    some of them off.
    """
    rng, shape = np.random.default_rng(seed), (envs, JOINTS)
    options: dict[str, Any] = {"kp": rng.uniform(0.5, 40, shape)}
    for name, (off, on) in NUMBERS.items():
        if rng.random() < 0.6:
            options[name] = np.where(
                rng.random(shape) < 0.3, off, on * rng.uniform(0.1, 1.0, shape)
            )
    strategies = [
        "none",
        "conditional",
        "back_calculation",
        *(["clamp"] if "effort_max" in options else []),
    ]
    options["anti_windup"] = rng.choice(strategies, shape).tolist()
    options["tracking_time"] = (
        rng.uniform(0.001, 0.3, shape)
        if "back_calculation" in np.ravel(options["anti_windup"])
        else None
    )
    options["continuous"] = rng.random(shape) < 0.5
    return options | {name: rng.choice(names).item() for name, names in NAMES.items()}


def read_only(value: Any, dtype: Any = np.float64) -> Any:
    array = np.array(value, dtype=dtype)
    array.setflags(write=False)
    return array


class Inputs(NamedTuple):
    """Inputs of the law, (steps, envs, joints) each; None for one that is not given."""

    setpoint: Any
    measurement: Any
    measurement_rate: Any = None
    setpoint_rate: Any = None
    feedforward: Any = None


def made_up_inputs(envs: int = ENVS) -> Inputs:
    """Thirty steps that saturate, wrap and reverse; float32 numbers, so that every executor gets
    the same.
    """
    rng = np.random.default_rng(7)
    steps = np.arange(30)[:, None, None]
    phase = rng.uniform(0, 6, (1, envs, JOINTS))
    measurement = 3 * np.sin(0.15 * steps + phase) + 0.3 * steps
    setpoint = np.where(steps < 12, 1.0, -2.0) * np.cos(phase) + 0.01 * steps
    noise = [rng.normal(size=measurement.shape) for _ in range(3)]
    return Inputs(
        *(np.asarray(x, np.float32).astype(float) for x in (setpoint, measurement, *noise))
    )
