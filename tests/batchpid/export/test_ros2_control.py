"""Parameters of ros2_control: the target's law against this one, and params that are written or
listed.
"""

import math

import numpy as np
import pytest
import yaml
from export_cases import DT, JOINTS, random_params
from hypothesis import given, settings

import batchpid as bp
from batchpid.export import to_ros2_control

CONTROLLER = "joint_trajectory_controller"


def target_effort(gains, memory, error, rate, desired_rate, dt):
    """One step of control_toolbox's PID with a feedforward of the desired velocity, on one
    joint.
    """
    u = gains["p"] * error + memory["i"] + gains["d"] * rate
    command = min(max(u, gains["u_clamp_min"]), gains["u_clamp_max"])
    strategy = gains["antiwindup_strategy"]
    if abs(error) > gains["error_deadband"]:
        if strategy == "back_calculation" and gains["i"] != 0:
            memory["i"] += dt * (
                gains["i"] * error + (command - u) / gains["tracking_time_constant"]
            )
        elif strategy == "none" or (
            strategy == "conditional_integration"
            and not (abs(u - command) > 2.3e-16 and error * u > 0)
        ):
            memory["i"] += dt * gains["i"] * error
    memory["i"] = min(max(memory["i"], gains["i_clamp_min"]), gains["i_clamp_max"])
    feedforward = gains["ff_velocity_scale"]
    return command + feedforward * desired_rate


def gains_of(text):
    return yaml.safe_load(text)[CONTROLLER]["ros__parameters"]["gains"]


def motion(steps=150):
    """A setpoint (steps, joints) and a measurement, with their rates."""
    t = np.arange(steps)[:, None] * DT
    w, far = np.array([3.0, 7.0, 11.0]), np.array([1.0, 0.5, 2.0])
    setpoint, measurement = far * np.sin(w * t) + 0.03, 0.7 * far * np.sin(0.8 * w * t)
    return setpoint, measurement, far * w * np.cos(w * t), 0.56 * far * w * np.cos(0.8 * w * t)


def target_run(text):
    gains, columns = gains_of(text), motion()
    memory = {joint: {"i": 0.0} for joint in gains}
    efforts = np.zeros_like(columns[0])
    for at, (r, y, r_rate, y_rate) in enumerate(zip(*columns, strict=True)):
        for j, (joint, own) in enumerate(gains.items()):
            error, rate = r[j] - y[j], r_rate[j] - y_rate[j]
            efforts[at, j] = target_effort(own, memory[joint], error, rate, r_rate[j], DT)
    return efforts


def run(params):
    columns = motion()
    state, efforts = bp.init(params, columns[1][:1]), []
    for r, y, r_rate, y_rate in zip(*(column[:, None] for column in columns), strict=True):
        rates = {"measurement_rate": y_rate, "setpoint_rate": r_rate}
        state, effort = bp.step(params, state, r, y, DT, **rates)
        efforts.append(effort[0])
    return np.array(efforts)


EXPRESSIBLE = {
    "pid": {},
    "limits": {"effort_limit": [30.0, 4.0, 1.0]},
    "one limit": {"effort_max": 3.0},
    "integral limit": {"integral_limit": 0.2},
    "clamp": {"effort_limit": 2.0, "anti_windup": "clamp"},
    "conditional": {"effort_limit": 2.0, "anti_windup": "conditional"},
    "back calculation": {
        "effort_limit": 2.0,
        "anti_windup": "back_calculation",
        "tracking_time": [0.1, 0.5, 0.02],
    },
    "mixed": {
        "effort_limit": 2.0,
        "anti_windup": "back_calculation",
        "tracking_time": [0.1, math.inf, math.inf],
    },
}


@pytest.mark.parametrize("case", EXPRESSIBLE)
def test_the_targets_law_gives_the_same_efforts(case):
    own = {"measurement_rate": "measured"}
    params = bp.make_params(
        3, [40.0, 20.0, 0.5], [50.0, 5.0, 2.0], [2.0, 0.3, 0.02], **EXPRESSIBLE[case], **own
    )
    exported = to_ros2_control(params, JOINTS, DT)
    assert {each.partition(":")[0] for each in exported.differences} <= {
        "effort_limit",
        "anti_windup",
    }
    np.testing.assert_allclose(target_run(exported.text), run(params), rtol=0, atol=1e-11)


def test_the_file_is_that_of_a_controller_manager():
    params = bp.make_params(3, 1.0, measurement_rate="measured")
    document = yaml.safe_load(to_ros2_control(params, JOINTS, 0.002, name="arm").text)
    assert document["controller_manager"]["ros__parameters"] == {
        "update_rate": 500,
        "arm": {"type": "joint_trajectory_controller/JointTrajectoryController"},
    }
    body = document["arm"]["ros__parameters"]
    assert body.pop("gains").keys() == set(JOINTS)
    assert body == {
        "joints": JOINTS,
        "command_interfaces": ["effort"],
        "state_interfaces": ["position", "velocity"],
    }


STRATEGIES = {"back_calculation", "conditional_integration", "none"}
FLOATS = [
    "p",
    "i",
    "d",
    "u_clamp_max",
    "u_clamp_min",
    "i_clamp_max",
    "i_clamp_min",
    "tracking_time_constant",
]
FLOATS += ["error_deadband", "ff_velocity_scale"]
"""Parameters of a joint that generate_parameter_library declares in ros2_controllers 6.9; its
doubles refuse integers.
"""


def check_schema(text):
    gains = gains_of(text)
    assert list(gains) == JOINTS
    for row in gains.values():
        assert row.pop("antiwindup_strategy") in STRATEGIES
        assert {name: type(value) for name, value in row.items()} == dict.fromkeys(FLOATS, float)
        assert not any(map(math.isnan, row.values()))
        # Checks of control_toolbox's gains.
        assert row["i_clamp_min"] <= 0 <= row["i_clamp_max"]
        assert row["u_clamp_min"] < row["u_clamp_max"]
        assert row["tracking_time_constant"] >= 0


@given(random_params())
@settings(max_examples=25, deadline=None)
def test_params_without_a_listed_difference_have_the_targets_efforts(params):
    params = params.replace(gain_units="effort", dtype=np.float64)
    exported = to_ros2_control(params, JOINTS, DT)
    check_schema(exported.text)
    # Without a feedforward, u_clamp is the effort limit; the motion has no error of exactly 0, and
    # none of half a turn.
    same = ("effort_limit", "continuous: taken", "anti_windup: back-calculation is left out")
    if not all(each.startswith(same) for each in exported.differences):
        return
    ours = run(params)
    atol = 1e-9 * max(1.0, np.abs(ours).max())
    np.testing.assert_allclose(target_run(exported.text), ours, rtol=1e-9, atol=atol)
