"""Cases that the tests of the law share: every option, array libraries, a made-up run."""

import dataclasses
from collections.abc import Callable
from typing import Any

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
    "weight from start": GAINS | {"setpoint_weight": 0.4, "weight_origin": "start"},
    "derivative weight": GAINS | {"setpoint_weight_derivative": [1.0, 0.3, 0.0], "derivative_filter_time": 0.02},
    "kick": GAINS | {"setpoint_weight_derivative": 1.0, "first_derivative": "kick"},
    "deadband": GAINS | {"deadband": [0.0, 0.3, 1.0]},
    "clamp": LIMITED | {"anti_windup": "clamp"},
    "conditional": LIMITED | {"anti_windup": "conditional"},
    "back calculation": LIMITED | {"anti_windup": "back_calculation", "tracking_time": [0.1, 0.001, 0.0]},
    "mixed": LIMITED | {"anti_windup": ["back_calculation", "conditional", "clamp"]},
    "mixed per env": LIMITED
    | {"anti_windup": [["none", "conditional", "clamp"], *[["back_calculation", "conditional", "none"]] * (ENVS - 1)]},
    "continuous": GAINS | {"continuous": [True, False, True]},
    "integrate first": LIMITED | {"integration": "integrate_first", "anti_windup": "conditional"},
    "zero effort": LIMITED | {"non_finite": "zero"},
    "hold effort": LIMITED | {"non_finite": "hold"},
    "everything": LIMITED
    | {
        "effort_rate_limit": 1000.0,
        "integral_limit": 4.0,
        "derivative_filter_time": 0.02,
        "setpoint_weight": 0.7,
        "setpoint_weight_derivative": 0.2,
        "deadband": 0.05,
        "anti_windup": ["back_calculation", "conditional", "clamp"],
        "continuous": [True, False, True],
        "integration": "integrate_first",
        "weight_origin": "start",
        "non_finite": "hold",
    },
}


@dataclasses.dataclass
class Backend:
    """An array library in one float type, as the law is used on it."""

    name: str
    dtype: Any
    array: Callable[[Any], Any]
    step: Callable[..., Any]

    @property
    def tolerance(self) -> float:
        return 1e-12 if self.dtype == np.float64 else 1e-5


def read_only(value: Any, dtype: Any = np.float64) -> Any:
    array = np.array(value, dtype=dtype)
    array.setflags(write=False)
    return array


@dataclasses.dataclass
class Inputs:
    """A made-up run: (steps, envs, joints) each."""

    setpoint: Any
    measurement: Any
    measurement_rate: Any
    setpoint_rate: Any
    feedforward: Any
