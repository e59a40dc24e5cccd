"""Tables of wrong calls: each raises an error that names the argument, and changes nothing."""

import dataclasses
import inspect
from copy import deepcopy
from functools import partial
from itertools import product

import numpy as np
import pytest
from featured import robot_with
from identical import assert_identical
from option_values import ARM, box, label
from robots import load_bundled
from thermal import Thermal

import batchpid as bp
from batchpid.errors import BatchPIDError, InvalidArgumentError
from batchpid.sim import (
    CommandSpec,
    MujocoSolver,
    OperationalSpace,
    Physics,
    Randomization,
    Robot,
    Runner,
    Uniform,
    read_recording,
)
from batchpid.sim.options.options import OPTIONS

DOF, N = ARM.dof, 2


class NowhereElse(Thermal):
    """A stage behind one that is not there."""

    name = "nowhere else"
    after = "nowhere"


class BehindTheLast(Thermal):
    """A stage behind the one that keeps what the others have said."""

    name = "behind the last"
    after = "last"


FREE = robot_with("floating base")
SAPIENS_OWN = dataclasses.replace(ARM, source=ARM.source._replace(dissipation="sapien"))
ROW, ROWS, NAN = np.zeros(DOF), np.zeros((N, DOF)), np.array([[0.0, 0.0], [np.nan, 0.0]])


class Odd:
    """Object that cannot be converted to an array."""

    def __array__(self, *_, **__):
        raise RuntimeError("cannot be an array")


class Hold:
    """Controller that only compensates the passive force; ``more`` are further attributes, such as
    ``command``.
    """

    def __init__(self, **more):
        vars(self).update(more)

    def init(self, robot, num_envs, timestep):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return None, passive


def named(call):
    """Return the name of the argument in the InvalidArgumentError of ``call``."""
    with pytest.raises(InvalidArgumentError) as caught:
        call()
    assert len(str(caught.value)) > 20
    return str(caught.value.argument)


# -- each argument by itself

JUNK = (object(), b"bytes", "no such value", -1.5, float("nan"), [object()], {"a": 1}, 1j)
ODD = (*JUNK, Odd(), int, range(3), [None], [[1.0], [1.0, 2.0]], ..., np.float64("-inf"), True)
ODD += (np.zeros(DOF + 1), np.zeros((2, 2, 2, 2)), np.zeros(DOF, "M8[s]"), NAN)
ODD += (None, "", (), np.zeros((0, DOF)))
PARAMS = ARM.params(kp=9.0, ki=1.0, kd=2.0)
PID = bp.BatchPID(PARAMS, N, 1e-3)
SAMPLE = {"measurement": ROWS, "setpoint": ROWS}
ENTRIES = {
    "BatchPID.__call__": (PID.__call__, SAMPLE),
    "BatchPID.reset": (PID.reset, {"measurement": ROWS}),
    "load_params": (bp.load_params, {"path": "none.yaml"}),
    "Robot.load": (Robot.load, {"name_or_path": "panda"}),
    "Robot.params": (ARM.params, {"kp": 1.0}),
    "Robot.designed": (ARM.designed, {}),
    "Robot.check": (ARM.check, {}),
    "read_recording": (read_recording, {"path": "none.h5"}),
}
"""Public functions with good values of the arguments that they need."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("entry", ENTRIES)
def test_a_value_of_any_kind_is_accepted_or_refused_by_name(entry, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function, good = ENTRIES[entry]
    bp.save_params("none.yaml", PARAMS, ARM.joint_names)
    for name, parameter in inspect.signature(function).parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            continue
        for value in ODD:
            PID.reset(ROWS)
            before = PID.state
            try:
                function(**{**good, name: deepcopy(value)})  # it may be written to
            except (BatchPIDError, FileNotFoundError, IsADirectoryError) as error:
                assert all(map(np.array_equal, PID.state, before))
                text = str(error)
                is_named = name.removesuffix("s") in text or "joint" in text or "path" in good
                assert is_named or isinstance(value, str), (name, value, text)


@pytest.mark.parametrize("name", [*OPTIONS])
def test_values_of_no_use_are_refused_for_every_option(name):
    options = {"robot": ARM, "num_envs": N, "workers": 0}
    if name in ("tool", "cluster"):
        options |= {"tool": {"control": "osc"}, "cluster": {"workers": None}}[name]
    refused = []
    for value in JUNK:
        try:
            Runner(**{**options, name: value}).close()
        except InvalidArgumentError as error:
            refused.append(error.argument)
    assert len(refused) == len(JUNK)
    assert {*refused} == {name}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("contain", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_call_with_any_value_changes_nothing_if_it_is_refused(contain):
    options = {"on_invalid_input": "contain"} if contain else {}
    command = {"setpoint": ROW, "setpoint_rate": ROW, "feedforward": ROW, "substeps": 2}
    table = {f"{name}s": command[name][None] for name in [*command][:3]}
    with Runner(ARM, N, workers=0, substeps=2, params=PARAMS, **options) as runner:
        calls = {
            "step": command,
            "rollout": table,
            "reset": {"qpos": ROW, "qvel": ROW, "mask": np.ones(N, bool), "seed": None},
            "restore": {"snapshot": None},
            "params": {"params": PARAMS},
        }
        for method, good in calls.items():
            for name, value in product(good, ODD):
                call = partial(act, runner, method, {**good, name: value})
                is_usable = value is None or (isinstance(value, float) and value == -1.5)
                assert is_refused(runner, call, name) or is_usable or contain, (name, value)
                seen = runner.observe()
                assert np.isfinite(seen.qpos[seen.ok]).all()
                runner.reset()
                runner.params = PARAMS
                assert runner.step(ROW).ok.all()


def act(runner, name, arguments):
    """Call a method, or set a property."""
    method = getattr(runner, name)
    if not callable(method):
        setattr(runner, *arguments.popitem())
        return
    method(**arguments)


def is_refused(runner, call, name):
    """Make a call: if it is refused by ``name``, it changes nothing."""
    before, time = runner.observe(), runner.time
    try:
        call()
    except BatchPIDError as error:
        assert name.removesuffix("s") in str(error), name  # noqa: PT017
        assert runner.time == time
        assert_identical(runner.observe(), before)
        return True
    return False


# -- constructors: options that are wrong by themselves or beside others

MOTORS = bp.make_actuators(DOF, strength=0.9)
PUSH = {"push": Uniform(0, 1)}
FREE_PUSHED = {"randomization": Randomization(**PUSH), "robot": FREE}
REFUSED = {
    Runner: [
        {"worker": 1},
        {"stages": [Thermal(1.0, 1.0), Thermal(1.0, 1.0)]},
        {"stages": [NowhereElse(1.0, 1.0)]},
        {"stages": [BehindTheLast(1.0, 1.0)]},
        {"workers": 2, "cluster": "ray"},
        {"physics": MujocoSolver(), "engine": "sapien"},
        {"physics": Physics("PGS", 4), "engine": "mujoco"},
        {"build": box, "engine": "mujoco"},
        {"build": box, "collisions": False},
        {"ground": True, "collisions": False},
        {"contacts": ["hand"], "collisions": False},
        {"contacts": ["foot"]},
        {"contacts": "hand"},
        {"wrenches": ["base"]},
        {"wrenches": ["hand"], "engine": "sapien"},
        {"collisions": False, "robot": FREE},
        {"control": "osc", "robot": FREE},
        {"robot": SAPIENS_OWN, "engine": "mujoco"},
        {"guard": True, "control": "effort"},
        {"guard": True, "control": Hold(command=CommandSpec(("x",)))},
        {"guard": bp.make_guard(1, rate=1.0)},
        {"plan": bp.make_plan(1, period=0.1, horizon=2)},
        {"plan": bp.make_plan(2, period=0.1, horizon=2), "control": "effort"},
        {"control": print},
        {"control": Hold(command="xy")},
        {"control": Hold(command=("x", "x"))},
        {"tool": ["hand"], "control": "osc"},
        {"tool": "hand"},
        {"params": load_bundled("panda").params()},
        {"params": ARM.params(kp=np.ones((3, DOF)))},
        {
            "gain_units": ...,
            "params": ARM.params(kp=1.0, gain_units="mass_matrix"),
            "control": "drive",
        },
        {"actuators": bp.make_actuators(3, strength=0.9)},
        {"actuators": bp.make_actuators(DOF, strength=np.full((3, DOF), 0.9))},
        {"actuators": MOTORS, "control": "drive"},
        {"latency": ..., "randomization": Randomization(latency=Uniform(0, 0.1))},
        {"push": ..., "randomization": Randomization(**PUSH, push_interval=Uniform(1, 2))},
        {"push_interval": ..., **FREE_PUSHED},
        {
            "push_interval": ...,
            **FREE_PUSHED,
            "randomization": Randomization(**PUSH, push_interval=Uniform(0, 1)),
        },
        {
            "push": ...,
            **FREE_PUSHED,
            "randomization": Randomization(push={"vq": Uniform(0, 1)}, push_interval=Uniform(1, 2)),
        },
        {
            "ground_friction": ...,
            "randomization": Randomization(ground_friction=Uniform(0, 1)),
            "collisions": False,
        },
    ],
    CommandSpec: [{"units": ("m",)}, {"neutral": (0, 1, 2)}, {"neutral": (np.inf, 0)}],
    ARM.guard: [{"rate": -1.0}],
    Robot.load: [{"dissipation": "none"}],
    OperationalSpace: [{"link": "foot"}],
}
"""By constructor, options of which the first is wrong; ``...`` is a part of an option after it."""
GOOD = {
    Runner: {"robot": ARM, "num_envs": N, "workers": 0},
    CommandSpec: {"names": ("x", "y")},
    Robot.load: {"name_or_path": "panda"},
    OperationalSpace: {"robot": ARM},
}


@pytest.mark.parametrize(
    ("make", "row"), [(make, row) for make, rows in REFUSED.items() for row in rows], ids=label
)
def test_refused_constructors_name_their_argument(make, row):
    options = {name: value for name, value in row.items() if value is not ...}
    assert next(iter(row)) in named(lambda: make(**GOOD.get(make, {}) | options))


# -- calls of a runner

ACCELERATED = {"setpoint_acceleration": ROW, "setpoint": ROW, "setpoint_rate": ROW}
UNUSED = [
    ("step", ACCELERATED),
    ("rollout", {f"{name}s": row[None] for name, row in ACCELERATED.items()}),
]
CALLS = [
    (
        {},
        [
            ("step", {"setpoint_acceleration": ROW, "setpoint": ROW}),
            ("step", {**ACCELERATED, "setpoint_acceleration": np.zeros(3)}),
            ("step", {"substeps": 0, "setpoint": ROW}),
            ("rollout", {"setpoints": ROW}),
            ("rollout", {"setpoints": np.zeros((4, 3, DOF))}),
            ("reset", {"mask": [True]}),
            ("reset", {"seed": 0}),
            ("reset", {"base_pose": np.zeros(7)}),
            ("reset", {"base_twist": np.zeros(6)}),
            ("bodies", {"names": ["ball"]}),
            ("params", {"params": load_bundled("panda").params()}),
        ],
    ),
    ({"params": ARM.params(kp=9.0)}, UNUSED),
    ({"control": "drive"}, UNUSED),
    ({"control": "effort"}, UNUSED),
    (
        {
            "robot": FREE,
            "engine": "mujoco",
            "ground": False,
            "randomization": Randomization(payload=Uniform(0, 1)),
        },
        [
            ("reset", {"base_pose": np.zeros(7)}),
            ("reset", {"base_pose": np.zeros(3)}),
            ("reset", {"base_twist": [0, 0, np.nan, 0, 0, 0]}),
            *(("reset", {"seed": seed}) for seed in (-1, 0.5, [1, 2, 3], [-1] * N)),
        ],
    ),
    (
        {"control": Hold(command=CommandSpec(("x", "y", "z")))},
        [
            ("step", {"setpoint": np.zeros((N, 2))}),
            ("step", {"setpoint_rate": np.zeros(2), "setpoint": np.zeros(3)}),
            ("step", {"feedforward": np.zeros(3), "setpoint": np.zeros(3)}),
        ],
    ),
]
"""Options of a runner, and its calls, each with arguments of which the first is wrong."""


@pytest.mark.parametrize(("options", "calls"), CALLS)
def test_a_refused_call_names_its_argument_and_changes_nothing(options, calls):
    with Runner(**GOOD[Runner] | options) as runner:
        start = runner.observe()
        for name, arguments in calls:
            assert is_refused(runner, partial(act, runner, name, arguments), next(iter(arguments)))
        size = runner.options.command.size
        assert runner.step(np.zeros(size) if runner.robot.fixed_base else start.qpos).ok.all()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"setpoint": np.zeros((N + 1, DOF))}, "setpoint: is for 3 envs, and there are 2; chunks"),
        ({"setpoint": np.zeros((N, 5, DOF))}, "setpoint: has 5 rows, and the plan a horizon of 4"),
        ({"setpoint": ROW, "setpoint_rate": ROW}, "setpoint_rate: has no effect with a plan"),
        ({"setpoint": ROW, "latency": -0.1}, "latency.* -0.1"),
    ],
)
def test_chunks_that_a_plan_cannot_take_are_refused_before_anything_changes(given, message):
    plan = bp.make_plan(DOF, period=0.1, horizon=4)
    with Runner(ARM, N, workers=0, plan=plan) as runner:
        with pytest.raises(InvalidArgumentError, match=message):
            runner.step(**given)
        assert runner.time == 0


def test_a_latency_without_a_plan_is_refused():
    words = "latency: has no effect without a plan"
    with Runner(ARM, N, workers=0) as runner, pytest.raises(InvalidArgumentError, match=words):
        runner.step(ROW, latency=0.1)
