"""Misuse of the public functions: each wrong value is refused by an error that names its argument
and a remedy.

Wrong values for options of joints come from the declared fields. Other wrong values come from a
table, by argument.
"""

import inspect
import math

import numpy as np
import pytest
from trees import planar, robot_of

import batchpid as bp
import batchpid.export
import batchpid.task_space as ts
from batchpid import metrics, motors, trajectories
from batchpid.arrays.array_types import CHOICES
from batchpid.errors import InvalidArgumentError
from batchpid.law.params import LAW_FIELDS
from batchpid.motors import friction, guard
from batchpid.motors.actuators import ACTUATOR_FIELDS

NAMES = ["shoulder", "elbow"]


def refused(argument, function, *arguments, **keywords):
    """Return the error of a call, which names ``argument`` and a remedy."""
    with pytest.raises(InvalidArgumentError) as caught:
        function(*arguments, **keywords)
    # A field, "params.kp", or a place in a text, "text: kp", may be named within its owner.
    assert argument in (
        caught.value.argument,
        *caught.value.argument.split(": "),
        *caught.value.argument.split("."),
    )
    assert caught.value.remedy
    return caught.value


# -- Options of joints, from the declared fields
# ---------------------------------------------------------------------

OPTIONS = [
    *((bp.make_params, {"kp": 1.0, "ki": 1.0}, name, field) for name, field in LAW_FIELDS.items()),
    *((bp.make_actuators, {}, name, field) for name, field in ACTUATOR_FIELDS.items()),
    *((bp.make_guard, {}, name, field) for name, field in guard.GUARD_FIELDS.items()),
]

NEEDS = {"tracking_time": {"anti_windup": "back_calculation", "effort_limit": 1.0}}
SPEEDS = {"saturation_effort": 1.0, "no_load_speed": 1.0}
NEEDS |= {name: SPEEDS for name in SPEEDS}
"""Options without which an option is refused."""


def outside(field):
    """Return numbers outside of the bounds of a declared field."""
    low = [] if math.isinf(field.low) else [field.low if field.above else field.low - 0.1]
    high = [] if math.isinf(field.high) else [1.5 * field.high]
    return [math.nan, *low, *high, *([] if math.isinf(field.neutral) else [math.inf])]


@pytest.mark.parametrize(
    ("make", "base", "name", "field"), OPTIONS, ids=lambda each: each if type(each) is str else ""
)
def test_options_of_joints(make, base, name, field):
    def error(value):
        return refused(
            name, make, 2, **(base | NEEDS.get(name, {}) | {name: value}), joint_names=NAMES
        )

    error([[1.0, 2.0], [1.0]])
    for value in (1j, np.ones(3), np.ones((1, 1, 2)), np.ones((0, 2))):
        error(value)
    if isinstance(field.neutral, float):
        for value in ("much", True):
            error(value)
        for value in outside(field):
            found = error(
                [[1.0, 1.0], [1.0, value]] if field.high >= 1 else [[0.1, 0.1], [0.1, value]]
            )
            assert (found.joint, found.env) == ("elbow", 1)
            assert found.value == value or math.isnan(value)


@pytest.mark.parametrize("name", CHOICES)
def test_choices_of_the_law(name):
    for value in ("other", None, []):
        refused(name, bp.make_params, 2, 1.0, **{name: value})


COMBINATIONS = {
    bp.make_params: [
        {"kp": None},
        {"kd": np.ones((4, 2)), "kp": np.ones((2, 2))},
        {"effort_min": [0, 2], "effort_max": 1},
        {"effort_limit": 1, "effort_max": 2},
        {"effort_limit": [1, math.nan]},
        {"tracking_time": 1.0},
        {
            "derivative_filter_time": 1e-3,
            "gain_units": "mass_matrix",
            "discretization": "implicit",
        },
    ],
    bp.make_actuators: [
        {"static": 0.1, "coulomb": [0.1, 0.2]},
        {"no_load_speed": ..., "saturation_effort": 10.0},
        {"saturation_effort": ..., "no_load_speed": 10.0},
        {"stribeck": 0.1, "coulomb": 0.2},
    ],
    motors.init: [
        {
            "max_delay": ...,
            "actuators": bp.make_actuators(2, lag=1.0, command_delay=1.0),
            "dt": 1e-6,
        }
    ],
    motors.dumps_actuators: [{"actuators": ..., "record": {}}],
    bp.make_guard: [{"lower": 1.0, "upper": 0.0}],
    bp.make_plan: [
        {"fade": 1.0, "blend": "newest"},
        *({"latest": [3]}, {"acceleration": 0.0}, {"period": 0.0}, {"horizon": 0}),
    ],
    ts.make_osc_params: [
        {"stiffness": [1.0, 2.0]},
        {"damping_ratio": math.nan},
        {"axes": [1, 0, 1, 1, 1, 1]},
        {"axes": [True]},
        {"posture_stiffness": [1.0] * 3},
        {"effort_limit": np.ones((2, 2)), "stiffness": np.ones((3, 6))},
        {"position_error_limit": -1.0},
        {"integral_gain": -1.0},
        {"integral_limit": math.nan, "integral_gain": 1.0},
        {"integral_limit": 1.0},
        {"limit_margin": -0.1},
        {"discretization": "other"},
    ],
    bp.step: [
        {
            "measurement_rate": ...,
            "params": bp.make_params(2, 1.0, kd=1.0, measurement_rate="measured"),
        }
    ],
    bp.track: [{"ki": ..., "params": bp.make_params(2, 1.0)}],
    batchpid.export.to_c: [
        {"params": bp.make_params(2, np.ones((2, 2)))},
        {"inputs": ("velocity",)},
        {"prefix": "a-b"},
        {"tree": planar((1.0,))},
    ],
    batchpid.export.to_ros2_control: [
        {"inertia": ..., "params": bp.make_params(2, 1.0, gain_units="mass_matrix")},
        {"inertia": [0.0, 1.0]},
        {"effort_min": ..., "params": bp.make_params(2, 1.0, effort_min=2, effort_max=2)},
    ],
    trajectories.minimum_jerk: [
        {"max_velocity": math.inf},
        {"max_velocity": [1.0, -1.0]},
        {"dt": 10**400, "duration": 1.0},
        {"duration": None},
        {"duration": 1.0, "max_velocity": 1.0},
    ],
    metrics.step_metrics: [
        {"measurement": np.zeros((1, 1, 2))},
        {"setpoint": np.zeros(3)},
        {"saturated": np.zeros((9, 1, 2))},
    ],
    bp.design_gains: [
        {"bandwidth_hz": 0.0},
        {"damping_ratio": -1.0},
        {"margin": 1.5},
        {"gain_units": "torque"},
        {"load": -1.0},
        {"load": 1.0, "gain_units": "mass_matrix"},
        {"discretization": "implicit", "gain_units": "effort"},
    ],
    bp.stability_bound: [{"mass_matrix": -np.eye(2)}, {"kp": [1.0, 2.0, 3.0]}],
    ts.inverse_kinematics: [
        {"starts": 0},
        {"on_failure": "ignore"},
        {"start": np.zeros((2, 2)), "pose": np.tile(np.eye(7)[3], (3, 1))},
    ],
}
"""By function, arguments of which the first is wrong, by itself or beside the others; ``...`` is not
passed.
"""


@pytest.mark.parametrize("function", COMBINATIONS, ids=lambda function: function.__name__)
def test_options_that_do_not_go_together(function):
    for row in COMBINATIONS[function]:
        changes = {name: value for name, value in row.items() if value is not ...}
        refused(next(iter(row)), function, **needed(function, changes) | changes)


PLACES = [
    (ts.make_osc_params, {"stiffness": [1, 1, -1, 1, 1, 1]}, {"entry": "z"}, -1.0),
    (ts.make_osc_params, {"smallest_eigenvalue": 0.0}, {"entry": "s0"}, 0.0),
    (ts.make_osc_params, {"posture_stiffness": [1.0, -1.0]}, {"joint": "joint2"}, -1.0),
    (ts.inverse_kinematics, {"pose": 2 * np.ones((1, 7))}, {"entry": "qw"}, 4.0),
    (ts.inverse_kinematics, {"point": [0.0, math.inf, 0.0]}, {"entry": "y"}, math.inf),
]


@pytest.mark.parametrize(("function", "changes", "places", "value"), PLACES)
def test_an_error_names_the_entry_and_its_value(function, changes, places, value):
    error = refused(*changes, function, **needed(function, changes) | changes)
    assert dict.fromkeys(("joint", "entry", "env")) | places == {
        name: getattr(error, name) for name in ("joint", "entry", "env")
    }
    assert error.value == value


# -- Other arguments, by their names
# ---------------------------------------------------------------------------------

MODULES = (bp, batchpid.export, ts, motors, friction, guard, metrics, trajectories)
Y, TREE = np.zeros((1, 2)), planar()
PARAMS = bp.make_params(2, 4.0, 1.0, 1.0)
OSC = ts.make_osc_params(TREE, 0.01, integral_gain=1.0)
POSE = ts.link_poses(TREE, Y, ["tip"])[:, 0]
MOTORS, GUARD = (
    bp.make_actuators(2, lag=0.1, sensor_delay=0.01, backlash=0.1),
    bp.make_guard(2, rate=1.0),
)
RUBBING = friction.Friction(np.ones((1, 2)), np.ones((1, 2)))
VALUES = {
    "num_envs": 1, "joints": 2, "joint_names": ["a", "b"], "measurement": Y, "setpoint": Y, "effort": Y, "qpos": Y,
    "qvel": Y, "tree": TREE, "link": "tip", "mass_matrix": np.eye(2), "inertia": np.ones((1, 2)), "kp": 1.0, "ki": 1.0,
    "kd": 1.0, "params": PARAMS, "actuators": MOTORS, "min_delay": 0, "max_delay": 1, "load": Y, "mask": [True],
    "guard": GUARD, "friction": RUBBING, "velocity": Y, "start": Y, "target": Y + 1, "end": Y + 1, "max_velocity": 1.0,
    "max_acceleration": 1.0, "max_jerk": 1.0, "robot": robot_of("panda"), "pose": POSE, "qacc": Y,
    "saturation_effort": 9.0, "velocity_limit": 5.0, "joint_parameter_lookup": [[0.0, 1.0, 1.0], [1.0, 1.0, 1.0]],
}  # fmt: skip
"""Values of required arguments, by their names."""
OWN = {
    "batchpid": {"state": bp.init(PARAMS, Y), "record": PARAMS},
    "batchpid.task_space": {
        "params": OSC,
        "state": ts.init(OSC, Y),
        "inputs": ts.OSCInputs(POSE, Y, Y),
        "dynamics": ts.task_dynamics(TREE, Y, Y, "tip"),
    },
    "batchpid.metrics": {"setpoint": np.ones((9, 1, 2)), "measurement": np.zeros((9, 1, 2))},
    "batchpid.motors": {"state": motors.init(MOTORS, Y, 0.01), "record": MOTORS},
    "batchpid.motors.guard": {"state": guard.init(GUARD, Y)},
    "batchpid.motors.friction": {
        "mass_matrix": np.eye(2)[None],
        "state": friction.init(RUBBING, Y, Y, np.eye(2)[None], 0.01),
    },
}
"""Those of the functions of a module."""
WRONG = {
    "dt": [0, -1e-3, math.nan, math.inf, "fast", 2000, np.float32(50.0), np.int64(240)],
    "joints": [0, 2.5, True, "two"],
    "num_envs": [0, 2.0, True],
    "backend": ["torch"],
    "dtype": [np.float16, "number"],
    "tree": ["panda", {}],
    "joint_names": [["a"], "ab", ["a", "a"], ["a", 2]],
    "params": [{"kp": 1}],
    "link": ["top", 3],
    "point": [0.1, [0.1], [0.1, 0.2]],
    "qpos": [np.zeros((1, 3)), "here"],
    "qvel": [np.zeros((1, 3))],
    "measurement": [
        np.zeros((4, 5)),
        "here",
        1j * Y,
        [["1", "2"]],
        np.array([["2020-01-01"] * 2], "datetime64"),
    ],
    "setpoint": [np.zeros((1, 3)), "there"],
    "effort": [np.ones((1, 3))],
    **{name: [np.ones((1, 3))] for name in ("measurement_rate", "setpoint_rate", "feedforward")},
    "mask": [[0], np.ones(3, bool)],
    "actuators": [bp.make_actuators(3, lag=0.1)],
    "seed": [-1, 0.5],
}
WRONG["timestep"] = WRONG["dt"]


def public(module):
    """Yield the public callables of a module."""
    own = (
        name
        for name, each in vars(module).items()
        if getattr(each, "__module__", None) == module.__name__
    )
    for name in getattr(module, "__all__", [name for name in own if not name.startswith("_")]):
        each = getattr(module, name)
        if callable(each) and not (isinstance(each, type) and issubclass(each, Exception | tuple)):
            yield name, each


PUBLIC = [(module.__name__, name, each) for module in MODULES for name, each in public(module)]


def needed(function, more=(), module=None):
    """Return good values of the required arguments of a function, and of ``more``."""
    module = module or next(owner for owner, _, each in PUBLIC if each is function)
    values = VALUES | OWN.get(module, {}) | {"duration": 1.0, "dt": 0.01, "timestep": 0.01}
    values |= {"setpoint": np.ones((9, 1, 2))} if function is metrics.step_metrics else {}
    values |= {"center": Y, "amplitude": Y, "frequency": 1.0, "period": 0.1, "horizon": 4}
    parameters = inspect.signature(function).parameters.items()
    required = {
        name
        for name, each in parameters
        if each.default is each.empty and each.kind is not each.VAR_KEYWORD
    }
    if function is trajectories.minimum_jerk and not more:
        required |= {"duration"}
    return {name: values[name] for name in required}


STEPS, BY_TYPE = {"dt", "timestep"}, {"params", "tree"}
CORE = {"batchpid.motors", "batchpid.motors.guard", "batchpid.motors.friction"}
HOT = {"advance", "discretise", "osc", "init", "reset", "track"}
"""Functions of a control loop besides the law's, which check only time steps and types of
params.
"""


def checked(module, name, function):
    """Return the arguments of WRONG that a function checks."""
    arguments = WRONG.keys() & inspect.signature(function).parameters.keys()
    is_law = module == "batchpid" and name in ("init", "reset", "track")
    if module in CORE:
        return arguments & STEPS
    return arguments & (STEPS | BY_TYPE) if name in HOT and not is_law else arguments


def rows():
    for module, name, function in PUBLIC:
        if not {"path", "text", "parent"} & inspect.signature(function).parameters.keys():
            for argument in checked(module, name, function):
                yield pytest.param(module, function, argument, id=f"{module}.{name}-{argument}")


@pytest.mark.parametrize(("module", "function", "argument"), sorted(rows(), key=lambda row: row.id))
def test_arguments_of_every_public_function(module, function, argument):
    good = needed(function, module=module)
    function(**good)
    for value in WRONG[argument]:
        error = refused(argument, function, **good | {argument: value})
        if argument in ("dt", "timestep") and isinstance(value, int | np.number) and value > 1:
            assert f"seconds, 1/{value:g}" in error.remedy, "a rate in place of a time step"


def test_an_unknown_option_is_answered_with_the_nearest():
    params, actuators = bp.make_params(2, 1.0), bp.make_actuators(2, lag=0.01)
    for function in (bp.make_params, bp.make_actuators):
        assert (
            "'effort_limit'"
            in refused("efort_limit", function, **needed(function), efort_limit=3.0).remedy
        )
    for function in (params.replace, actuators.replace):
        assert "'effort_limit'" in refused("efort_limit", function, efort_limit=3.0).remedy
    assert "joints, kp, ki, kd" in refused("zzzzzzz", bp.make_params, 2, kp=1.0, zzzzzzz=1).remedy


# -- Texts
# --------------------------------------------------------------------------------------------------

PID = '{"format": "batchpid-params-2", "joints": {"elbow": {%s}}}'
MOTOR = "format: batchpid-actuators-2\njoints: {elbow: {%s}}"
TEXTS = [
    *((text, "text", None) for text in ('{"joints": {}}', "[1, 2]", '{"format": "batchpid')),
    ('{"format": "batchpid-params-2", "joint": {}}', "key", None),
    ('{"format": "batchpid-params-2", "joints": {}}', "joints", None),
    (PID % '"kd": 1.0', "joints", "elbow"),
    (PID % '"kp": 1.0, "kq": 2.0', "kq", "elbow"),
    *((PID % f'"kp": {value}', "kp", "elbow") for value in ("-1.0", '"nan"', "true", "[]")),
    (PID % f'"kp": 1{"0" * 400}', "kp", "elbow"),
    (
        '{"format": "batchpid-params-2", "anti_windup": [], "joints": {"a": {"kp": 1.0}}}',
        "anti_windup",
        None,
    ),
    (
        '{"format": "batchpid-params-2", "dtype": "object", "joints": {"a": {"kp": 1.0}}}',
        "dtype",
        None,
    ),
    ('{"format": "batchpid-params-2", "about": 3, "joints": {"a": {"kp": 1.0}}}', "about", None),
    (MOTOR % "kp: 1", "kp", "elbow"),
    (MOTOR % "strength: strong", "strength", "elbow"),
    ("format: batchpid-actuators-2\njoints: {shoulder: {}}", "text", None),
    ("format: batchpid-actuators-2\njoints: {elbow: [1]}", "joints", "elbow"),
    ("format: batchpid-actuators-2\nseed: soon\njoints: {elbow: {}}", "seed", None),
    *((text, "text", None) for text in ("- 1", "format: [")),
]
"""Text of params or of actuators, the key that is wrong, and its joint."""


@pytest.mark.parametrize(("text", "key", "joint"), TEXTS, ids=range(len(TEXTS)))
def test_texts(text, key, joint, tmp_path):
    """As a file, whose error names it; as a text, if it is JSON."""
    load = bp.load_actuators if "actuators" in text else bp.load_params
    names = [["elbow"]] if "actuators" in text else []
    if text[0] in "{[":
        assert refused(key, bp.loads_params, text, *names).joint == joint
    (path := tmp_path / "file.yaml").write_text(text)
    error = refused(str(path) if key == "text" else key, load, path, *names)
    assert str(path) in str(error)
    assert error.joint == joint


def arrays(value):
    """Yield the arrays of a value, and of the tuples in it."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from arrays(part)


HELD = bp.make_params(2, 4.0, 1.0, 1.0, effort_rate_limit=9.0, derivative_filter_time=0.1)
LAW = {bp.init, bp.step, bp.reset, bp.track}
RATES = ("measurement_rate", "setpoint_rate", "feedforward")


@pytest.mark.parametrize(
    ("module", "function"),
    dict.fromkeys([*(row.values[:2] for row in rows()), (guard.__name__, guard.init)]),
)
def test_a_result_shares_no_memory_with_an_argument(module, function):
    """A caller may write the next values into its arrays."""
    held = {"params": HELD, "state": bp.init(HELD, Y)} if function in LAW else {}
    given = needed(function, module=module) | dict.fromkeys(RATES, Y) | held
    names = given.keys() & inspect.signature(function).parameters.keys()
    copies = {
        name: given[name] + 0.0 if isinstance(given[name], np.ndarray) else given[name]
        for name in names
    }
    found = [*arrays(function(**copies))]
    for argument in copies.values():
        if isinstance(argument, np.ndarray):
            assert not any(np.shares_memory(each, argument) for each in found)
