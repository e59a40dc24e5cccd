"""Cases that the tests of the law share: every option, a made-up run, and its efforts."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from c_programs import RESET, efforts_in_c

import batchpid as bp
from batchpid.export import to_c
from batchpid.law import advance_with_mass_matrix

JOINTS, ENVS, DT = 3, 4, 0.01
UNITS = ("effort", "mass_matrix", "implicit")
"""Kinds of law of generated_options."""

GAINS = {"kp": [40.0, 20.0, 0.5], "ki": [5.0, 50.0, 0.0], "kd": [2.0, 0.3, 0.02]}
LIMITED = GAINS | {"effort_limit": [30.0, 8.0, 1.0]}
OPTIONS = {
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
    "continuous": GAINS | {"continuous": [True, False, True]},
    "everything": (
        LIMITED
        | {
            "effort_rate_limit": 1000.0,
            "integral_limit": 4.0,
            "derivative_filter_time": 0.02,
            "setpoint_weight": 0.7,
            "setpoint_weight_derivative": 0.2,
            "deadband": 0.05,
            "anti_windup": "back_calculation",
            "continuous": [True, False, True],
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
DRIVE_LACKS = (
    *("effort_rate_limit", "derivative_filter_time", "setpoint_weight"),
    *("setpoint_weight_derivative", "deadband"),
)
"""Options of the law that a drive does not have."""


def generated_options(seed, envs=ENVS, joints=JOINTS, units="effort"):
    """Return arguments of make_params of any combination, with an entry for each env and joint,
    some of them off. ``units`` are the gain_units; "implicit" is the law of that name.
    """
    rng, shape = np.random.default_rng(seed), (envs, joints)
    options = {"kp": rng.uniform(0.5, 40, shape)}
    for name, (off, on) in NUMBERS.items():
        if rng.random() < 0.6:
            options[name] = np.where(
                rng.random(shape) < 0.3, off, on * rng.uniform(0.1, 1.0, shape)
            )
    strategies = ["none", "conditional"]
    if np.isfinite(options.get("effort_max", np.inf)).any():
        strategies.append("clamp")
    if units == "effort":
        strategies.append("back_calculation")
    options["anti_windup"] = rng.choice(strategies).item()
    if options["anti_windup"] == "back_calculation":
        time = rng.uniform(0.001, 0.3, shape)
        options["tracking_time"] = np.where(rng.random(shape) < 0.3, math.inf, time)
    options["continuous"] = rng.random(shape) < 0.5
    if units == "implicit":
        options.pop("derivative_filter_time", None)
        options["discretization"] = "implicit"
    return options | {"gain_units": "effort" if units == "effort" else "mass_matrix"}


def read_only(value, dtype=np.float64):
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
    setpoint_acceleration: Any = None
    """For gains per mass matrix alone."""
    mass_matrix: Any = None
    """(steps, envs, joints, joints), for gains per mass matrix."""

    def given(self, *names):
        """Return these inputs with the optional ones of ``names`` alone."""
        return Inputs(*self[:2], **{name: getattr(self, name) for name in names})

    def at(self, step, array=np.asarray):
        """Return the given inputs of a step, by name."""
        return {
            name: array(rows[step]) for name, rows in self._asdict().items() if rows is not None
        }


def made_up_inputs(envs=ENVS, joints=JOINTS, count=30):
    """Return ``count`` steps that saturate, wrap and reverse; float32 numbers, so that every executor gets the
    same.
    """
    rng = np.random.default_rng(7)
    steps = np.arange(count)[:, None, None]
    phase = rng.uniform(0, 6, (1, envs, joints))
    measurement = 3 * np.sin(0.15 * steps + phase) + 0.3 * steps
    measurement[..., 0] = (measurement[..., 0] + np.pi) % (2 * np.pi) - np.pi
    setpoint = np.where(steps < 12, 1.0, -2.0) * np.cos(phase) + 0.01 * steps
    noise = [scale * rng.normal(size=measurement.shape) for scale in (1, 1, 5, 1)]
    root = rng.normal(size=(count, envs, joints, joints))
    matrix = 0.1 * (root @ root.mT + np.eye(joints))
    arrays = setpoint, measurement, *noise, matrix
    return Inputs(*(np.asarray(each, np.float32).astype(float) for each in arrays))


def advanced(params, state, row):
    """Return state and effort of the pure functions after a step with the inputs ``row``."""
    if "mass_matrix" not in row:
        return bp.step(params, state, dt=DT, **row)
    state, terms = advance_with_mass_matrix(bp.discretise(params, DT), state, **row)
    return state, terms.effort


def by_steps(
    params,
    inputs,
    step=advanced,
    array=read_only,
    keep=True,
):
    """Return the efforts (steps, envs, joints) of ``step``; ``array`` makes its arrays, by default
    read-only ones. Without ``keep`` the reset takes the integral, too.
    """
    own = [array(leaf, params.dtype) if isinstance(leaf, np.ndarray) else leaf for leaf in params]
    params = bp.PIDParams(*own)
    state, efforts = bp.init(params, array(inputs.measurement[0], params.dtype)), []
    for at in range(len(inputs.setpoint)):
        row = inputs.at(at, lambda rows: array(rows, params.dtype))
        if at == RESET:
            mask = np.ones(len(row["measurement"]), bool)
            fresh = bp.reset(params, state, row["measurement"], mask)
            state = fresh._replace(integral=state.integral) if keep else fresh
        state, effort = step(params, state, row)
        assert effort.dtype == params.dtype
        efforts.append(np.asarray(effort, float))
    return np.array(efforts)


def by_c(
    params,
    inputs,
    *flags,
    compiler=None,
    guard=None,
):
    """Return the efforts (steps, 1, joints) of the header for the first env."""
    params = params.for_envs(slice(1))
    columns = {
        name: rows[:, 0].astype(params.dtype)
        for name, rows in inputs._asdict().items()
        if rows is not None
    }
    names = [name for name in columns if name not in ("setpoint", "measurement", "mass_matrix")]
    with TemporaryDirectory() as folder:
        header = to_c(params, DT, inputs=names, guard=guard, prefix="arm").text
        options = {"prefix": "arm", "compiler": compiler}
        found = efforts_in_c(Path(folder), params, header, columns, *flags, **options)
    return found[:, None].astype(float)
