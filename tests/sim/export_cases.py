"""Cases that the tests of exports share: random params of any options, as comparable values."""

import math

import numpy as np
from hypothesis import strategies as st

import batchpid as bp

DT = 0.004
JOINTS = ["shoulder", "elbow", "wrist"]

number = st.just(0.0) | st.floats(1e-30, 1e3)  # a normal float32, in units of an inertia too
OPTION = {
    "ki": number,
    "kd": number,
    "effort_limit": st.floats(1e-30, 1e3),
    "effort_max": st.floats(-5.0, 1e3),
    "effort_rate_limit": st.floats(1.0, 1e3),
    "integral_min": st.floats(-10.0, 0.5, allow_subnormal=False),
    "integral_max": st.floats(0.6, 10.0),
    "derivative_filter_time": st.floats(0, 0.1),
    "setpoint_weight": st.floats(0, 1),
    "setpoint_weight_derivative": st.floats(0, 1),
    "deadband": st.floats(1e-6, 0.1),
    "tracking_time": st.floats(1e-4, 1.0),
    "anti_windup": st.sampled_from(["none", "clamp", "conditional", "back_calculation"]),
    "continuous": st.booleans(),
    "measurement_rate": st.sampled_from(["difference", "measured"]),
    "gain_units": st.sampled_from(["effort", "mass_matrix"]),
    "dtype": st.sampled_from([np.float32, np.float64]),
}
SHARED = ("anti_windup", "measurement_rate", "gain_units", "dtype")


@st.composite
def random_params(draw):
    chosen = draw(st.sets(st.sampled_from(sorted(OPTION)), max_size=8))
    if "effort_limit" in chosen:
        chosen.discard("effort_max")
    if "tracking_time" in chosen:
        chosen.discard("anti_windup")
    columns = {
        name: draw(
            OPTION[name] if name in SHARED else st.lists(OPTION[name], min_size=3, max_size=3)
        )
        for name in chosen
    }
    if columns.get("anti_windup") == "clamp":
        columns["effort_limit"] = 50.0
        columns.pop("effort_max", None)
    if "tracking_time" in chosen:
        columns["anti_windup"] = "back_calculation"
    if columns.get("gain_units") == "mass_matrix":  # whose law lacks these
        for name in ("tracking_time", "anti_windup"):
            columns.pop(name, None)
    if columns.get("anti_windup") == "back_calculation" and "tracking_time" not in columns:
        columns["tracking_time"] = 0.3
    return bp.make_params(3, draw(st.lists(number, min_size=3, max_size=3)), **columns)


NEUTRAL = {
    "ki": 0.0,
    "kd": 0.0,
    "effort_min": -math.inf,
    "effort_max": math.inf,
    "effort_rate_limit": math.inf,
}
NEUTRAL |= {
    "integral_min": -math.inf,
    "integral_max": math.inf,
    "setpoint_weight": 1.0,
    "tracking_time": math.inf,
}


def values(params, name):
    """Return an option as comparable values (joints,)."""
    leaf = getattr(params, name)
    if isinstance(leaf, tuple):
        return [1.0] * 3
    return [NEUTRAL.get(name, 0.0)] * 3 if leaf is None else leaf[0].astype(float).tolist()
