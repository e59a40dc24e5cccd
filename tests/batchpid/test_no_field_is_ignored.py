"""Every field of params and motors is in an export or a listed difference, and every one of OSC
params changes the result; the other fields have oracles in the tables of conformance.
"""

from dataclasses import replace

import numpy as np
import pytest
from tiny_urdf import one_joint, write
from trees import planar

import batchpid as bp
import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError
from batchpid.export import to_c, to_ros2_control
from batchpid.law import advance_with_mass_matrix
from batchpid.sim import Robot, to_mjcf

DT, JOINTS = 0.01, ["a", "b", "c"]
LIMITS = {
    "effort_min": [-30.0, -3.0, -2.0],
    "effort_max": [29.0, 3.5, 2.5],
    "integral_min": [-20.0, -1.5, -1.5],
}
LIMITS["integral_max"] = [18.0, 1.2, 1.2]
FULL = LIMITS | {
    "kp": [9.0, 5.0, 3.0],
    "ki": [9.0, 9.0, 5.0],
    "kd": [2.0, 0.6, 0.3],
    "anti_windup": "back_calculation",
    "tracking_time": 0.05,
    "continuous": [True, False, True],
    "effort_rate_limit": [300.0, 100.0, 60.0],
    "derivative_filter_time": 0.02,
    "setpoint_weight": 0.7,
    "setpoint_weight_derivative": 0.2,
    "deadband": 0.1,
}
PLAIN = bp.make_params(1, 1.0)
NAMES = {
    "measurement_rate": ("difference", "measured"),
    "gain_units": ("effort", "mass_matrix"),
}
CHOICES = {
    option: {name: getattr(PLAIN.replace(**{option: name}), option) for name in names}
    for option, names in NAMES.items()
}
IMPLICIT = PLAIN.replace(gain_units="mass_matrix", discretization="implicit").discretization
CHOICES["discretization"] = {"explicit": None, "implicit": IMPLICIT}


def changes(params, choices):
    """Yield a label, the field and the params for every field with another value: every other name
    of a choice.
    """
    for name, leaf in params._asdict().items():
        for other, chosen in choices.get(name, {}).items():
            if type(chosen) is not type(leaf):
                yield f"{name}={other}", name, params._replace(**{name: chosen})
        if isinstance(leaf, np.ndarray):
            is_mask = name in ("continuous", "axes")
            yield (
                name,
                name,
                params._replace(
                    **{name: 1 - leaf if is_mask else (leaf * 1.25).astype(leaf.dtype)}
                ),
            )


def outcome(function, *arguments):
    """Return the result as bytes, so that NaN equals itself; or the message of a refusal."""
    try:
        found = function(*arguments)
    except InvalidArgumentError as error:
        return str(error)
    return found if isinstance(found, tuple) else np.asarray(found).tobytes()


def ignored(function, base, choices):
    """Return the names of the changes that do not change the outcome of a function."""
    plain = outcome(function, base)
    return {
        label for label, _, other in changes(base, choices) if outcome(function, other) == plain
    }


def test_coefficients_of_accelerations_need_the_robots_inertia():
    params, y = bp.make_params(2, 4.0, 1.0, 1.0, gain_units="mass_matrix"), np.zeros((1, 2))
    k, state = bp.discretise(params, DT), bp.init(params, y)
    with pytest.raises(
        InvalidArgumentError, match=r"gain_units.*mass matrix.*designed\('effort'\)"
    ):
        bp.advance(k, state, y, y)
    advance_with_mass_matrix(k, state, y, y, np.eye(2)[None])


INERTIA = [1.0, 0.5, 0.2]
TARGETS = {
    "C": lambda p: to_c(p, DT),
    "trajectory": lambda p: to_ros2_control(p, JOINTS, DT, inertia=INERTIA),
}
PART_OF = {name: "ki" for name in ("integral_min", "integral_max", "tracking_time")}
"""Fields of a term, which its own difference contains."""
LABELS = {"tracking_time": "anti_windup"}
LABELS |= {f"{of}_{end}": f"{of}_limit" for of in ("effort", "integral") for end in ("min", "max")}
"""Options by which differences name the fields."""


@pytest.mark.parametrize("target", TARGETS)
def test_every_field_of_params_is_exported_or_a_difference(target):
    base = bp.make_params(3, **FULL)
    plain = TARGETS[target](base)
    listed = {each.partition(":")[0] for each in plain.differences}
    for label, name, params in changes(base, CHOICES):
        same = outcome(TARGETS[target], params) == plain
        assert not same or {LABELS.get(name, name), PART_OF.get(name)} & listed, label


OWN = {"continuous", "max_delay", "seed"}
MOTORS = {name: 0.25 for name in bp.Actuators._fields if name not in OWN}
MOTORS |= {"no_load_speed": 9.0}
PART_OF_MOTORS = {"no_load_speed": "saturation_effort"}


def test_every_field_is_in_an_mjcf_or_a_difference(tmp_path):
    hinge, part_of = Robot.load(write(tmp_path, one_joint())), PART_OF | PART_OF_MOTORS

    def exported(params, motors):
        return to_mjcf(replace(hinge, actuators=motors), params, DT, inertia=[1.0])

    params = bp.make_params(3, **FULL).for_joints([1])
    full = bp.make_actuators(1, **MOTORS)._replace(seed=None, max_delay=None)
    tried = [(name, (params, None), (other, None)) for _, name, other in changes(params, CHOICES)]
    tried += [(name, (params, full), (params, other)) for _, name, other in changes(full, {})]
    for name, base, other in tried:
        plain = exported(*base)
        listed = {each.partition(":")[0] for each in plain.differences}
        assert (
            outcome(exported, *other) != plain
            or {LABELS.get(name, name), part_of.get(name)} & listed
        ), name


def test_every_field_of_osc_params_changes_the_efforts():
    tree = planar((1.0, 0.8, 0.5, 0.4))
    tree = ts.RigidTree(
        **{**tree_fields(tree), "lower": [-3.0, -3.0, -3.0, -np.inf], "upper": [3.0] * 3 + [np.inf]}
    )
    q = np.array([[2.9, -2.8, 0.7, 9.0], [0.3, 0.4, 2.8, -9.0], [0.3, 0.4, 0.8, 9.0]])
    pose = ts.link_poses(tree, np.add(q, [[0.02], [0.3], [-0.3]]), ["tip"])[:, 0]
    options = {"integral_gain": 300.0, "integral_limit": 0.2, "limit_margin": 0.5}
    options |= {"smallest_eigenvalue": 0.5, "position_error_limit": 0.2}
    options |= {"effort_limit": np.array([[900.0], [6.0], [5.0]]) * np.ones((3, 4))}
    base = ts.make_osc_params(
        tree,
        DT,
        rotation_error_limit=0.1,
        axes=[True, False, False, False, False, True],
        discretization="implicit",
        **options,
    )

    def run(params):
        state, results = ts.init(params, 0.7 * q), []
        for at in range(4):
            moving = {name: np.full((3, 6), 0.1) for name in ("wrench", "twist", "acceleration")}
            inputs = ts.OSCInputs(pose, q + 0.01 * at, 0.3 * q, **moving)
            state, terms = ts.osc(params, state, ts.Tool(tree, "tip"), inputs)
            results += [terms.effort, state.integral]
        return np.concatenate([each.ravel() for each in results])

    assert not ignored(run, base, {})


def tree_fields(tree):
    return {name: getattr(tree, name) for name in tree.__dataclass_fields__ if name != "_"}
