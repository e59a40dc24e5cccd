"""Tables of wrong calls: each raises an error that names the argument, and changes nothing."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

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
    Ray,
    Recorder,
    Robot,
    Runner,
    Snapshot,
    Uniform,
    read_recording,
)
from batchpid.sim.options.options import OPTIONS

DOF, N = ARM.dof, 2


class NowhereElse(Thermal):
    """A stage behind one that is not there."""

    name = "nowhere else"
    after = "nowhere"


FREE = robot_with("floating base")
SAPIENS_OWN = dataclasses.replace(ARM, dissipation="sapien")
ROW, ROWS, NAN = np.zeros(DOF), np.zeros((N, DOF)), np.array([[0.0, 0.0], [np.nan, 0.0]])


class Odd:
    """Object that cannot be converted to an array."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("cannot be an array")


class Hold:
    """Controller that only compensates the passive force; ``more`` are further attributes, such as
    ``command``.
    """

    def __init__(self, **more: Any) -> None:
        vars(self).update(more)

    def init(self, robot: Any, num_envs: int, timestep: float) -> Any:
        return None

    def __call__(self, state: Any, setpoint: Any, qpos: Any, qvel: Any, passive: Any) -> Any:
        return None, passive


def named(call: Callable[[], Any]) -> str:
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
BOUND = {"mass_matrix": np.eye(DOF), "kp": 1.0, "kd": 1.0, "dt": 1e-3}
ENTRIES: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "make_params": (bp.make_params, {"joints": DOF, "kp": 1.0}),
    "make_actuators": (bp.make_actuators, {"joints": DOF}),
    "BatchPID": (bp.BatchPID, {"params": PARAMS, "num_envs": N, "dt": 1e-3}),
    "BatchPID.__call__": (PID.__call__, SAMPLE),
    "BatchPID.reset": (PID.reset, {"measurement": ROWS}),
    "BatchPID.track": (PID.track, SAMPLE | {"effort": ROWS}),
    "stability_bound": (bp.stability_bound, BOUND),
    "spectral_radius": (bp.spectral_radius, BOUND | {"ki": 1.0}),
    "load_params": (bp.load_params, {"path": "none.yaml"}),
    "Robot.load": (Robot.load, {"name_or_path": "panda"}),
    "Robot.params": (ARM.params, {"kp": 1.0}),
    "Robot.designed": (ARM.designed, {}),
    "Robot.check": (ARM.check, {}),
    "Snapshot.load": (Snapshot.load, {"path": "none.npz"}),
    "read_recording": (read_recording, {"path": "none.h5"}),
}
"""Public functions with good values of the arguments that they need."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("entry", ENTRIES)
def test_a_value_of_any_kind_is_accepted_or_refused_by_name(
    entry: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
def test_values_of_no_use_are_refused_for_every_option(name: str) -> None:
    options = {"robot": ARM, "num_envs": N, "workers": 0}
    if name in ("tool", "cluster"):
        options |= {"tool": {"control": "osc"}, "cluster": {"workers": None}}[name]
    refused = []
    for value in JUNK:
        try:
            Runner(**{**options, name: value}).close()
        except InvalidArgumentError as error:
            refused.append(error.argument)
    assert len(refused) >= len(JUNK) - 1  # a number may be a name of a Ray cluster
    assert {*refused} == {name}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("contain", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_call_with_any_value_changes_nothing_if_it_is_refused(contain: bool) -> None:
    options = {"on_invalid_input": "contain"} if contain else {}
    command = {"setpoint": ROW, "setpoint_rate": ROW, "feedforward": ROW, "substeps": 2}
    table = {f"{name}s": command[name][None] for name in [*command][:3]}
    with Runner(ARM, N, workers=0, substeps=2, params=PARAMS, **options) as runner:
        methods: list[tuple[Callable[..., Any], dict[str, Any]]] = [
            (runner.step, command),
            (lambda **given: runner.send(**given) or runner.recv(), command),
            (runner.rollout, table),
            (runner.reset, {"qpos": ROW, "qvel": ROW, "mask": np.ones(N, bool), "seed": None}),
            (runner.restore, {"snapshot": None}),
            (lambda params: setattr(runner, "params", params), {"params": PARAMS}),
            (lambda actuators: setattr(runner, "actuators", actuators), {"actuators": None}),
        ]
        for function, good in methods:
            for name in good:
                for value in ODD:
                    call = partial(function, **{**good, name: value})
                    is_usable = value is None or (isinstance(value, float) and value == -1.5)
                    assert is_refused(runner, call, name) or is_usable or contain, (name, value)


def is_refused(runner: Runner, call: Callable[[], Any], name: str) -> bool:
    """Make a call: if it is refused, it changes nothing, and the runner goes on in any case."""
    before, time, refused = runner.observe(), runner.time, False
    try:
        call()
    except BatchPIDError as error:
        refused = True
        assert name.removesuffix("s") in str(error), name  # noqa: PT017
        assert runner.time == time
        assert_identical(runner.observe(), before)
    seen = runner.observe()
    assert np.isfinite(seen.qpos[seen.ok]).all()
    runner.reset()
    runner.params = PARAMS
    assert runner.step(ROW).ok.all()
    return refused


# -- options that exclude each other

MOTORS = bp.make_actuators(DOF, strength=0.9)
PUSHES = {"push": Uniform(0, 1), "push_interval": Uniform(1, 2)}
RUNNERS: list[tuple[dict[str, Any], str]] = [
    ({"worker": 1}, "worker"),
    ({"engine": "bullet"}, "engine"),
    ({"backend": "torch"}, "backend"),
    ({"stages": [np.zeros(DOF)]}, "stages"),
    ({"stages": [Thermal(1.0, 1.0), Thermal(1.0, 1.0)]}, "stages"),
    ({"stages": [NowhereElse(1.0, 1.0)]}, "stages"),
    ({"cluster": "ray", "workers": 2}, "workers"),
    ({"cluster": "slurm"}, "cluster"),
    ({"physics": MujocoSolver(), "engine": "sapien"}, "physics"),
    ({"physics": Physics("PGS", 4), "engine": "mujoco"}, "physics"),
    ({"build": box, "engine": "mujoco"}, "build"),
    ({"build": box, "collisions": False}, "build"),
    ({"ground": True, "collisions": False}, "ground"),
    ({"contacts": ["hand"], "collisions": False}, "contacts"),
    ({"contacts": ["foot"]}, "contacts"),
    ({"contacts": "hand"}, "contacts"),
    ({"wrenches": ["base"]}, "wrenches"),
    ({"robot": FREE, "collisions": False}, "collisions"),
    ({"robot": FREE, "control": "osc"}, "control"),
    ({"robot": SAPIENS_OWN, "engine": "mujoco"}, "robot"),
    ({"speed_limit": np.full(DOF, np.inf)}, "speed_limit"),
    ({"speed_limit": np.ones(3)}, "speed_limit"),
    ({"guard": True, "control": "effort"}, "guard"),
    ({"guard": True, "control": Hold(command=CommandSpec(("x",)))}, "guard"),
    ({"guard": bp.make_guard(1, rate=1.0)}, "guard"),
    ({"plan": bp.make_plan(1, period=0.1, horizon=2)}, "plan"),
    ({"plan": bp.make_plan(2, period=0.1, horizon=2), "control": "effort"}, "plan"),
    ({"control": print}, "control"),
    ({"control": Hold(command="xy")}, "control"),
    ({"control": Hold(command=("x", "x"))}, "control"),
    ({"control": ["pid"]}, "control"),
    ({"control": "osc", "tool": ["hand"]}, "tool"),
    ({"tool": "hand"}, "tool"),
    ({"params": load_bundled("panda").params()}, "params"),
    ({"params": ARM.params(kp=np.ones((3, DOF)))}, "params"),
    ({"params": ARM.params(kp=1.0, gain_units="mass_matrix"), "control": "drive"}, "gain_units"),
    ({"actuators": bp.make_actuators(3, strength=0.9)}, "actuators"),
    ({"actuators": bp.make_actuators(DOF, strength=np.full((3, DOF), 0.9))}, "actuators"),
    ({"actuators": MOTORS, "control": "drive"}, "actuators"),
    ({"randomization": Randomization(**PUSHES)}, "push"),
    ({"robot": FREE, "randomization": Randomization(push=Uniform(0, 1))}, "push_interval"),
    (
        {
            "robot": FREE,
            "randomization": Randomization(push=Uniform(0, 1), push_interval=Uniform(0, 1)),
        },
        "push_interval",
    ),
    (
        {
            "robot": FREE,
            "randomization": Randomization(push={"vq": Uniform(0, 1)}, push_interval=Uniform(1, 2)),
        },
        "push",
    ),
    (
        {"randomization": Randomization(ground_friction=Uniform(0, 1)), "collisions": False},
        "ground_friction",
    ),
]


@pytest.mark.parametrize(("options", "argument"), RUNNERS, ids=label)
def test_options_that_do_not_go_together_are_refused_by_name(
    options: dict[str, Any], argument: str, request: pytest.FixtureRequest
) -> None:
    if options.get("backend") == "jax":
        request.getfixturevalue("needs_jax")
    options = {"robot": ARM, "num_envs": N, **options}
    options.setdefault("workers", None if "cluster" in options else 0)
    assert argument in named(lambda: Runner(**options))


# -- calls of a runner

CALLS: list[tuple[str, dict[str, Any], str]] = [
    ("step", {"setpoint": ROW, "setpoint_acceleration": ROW}, "setpoint_acceleration"),
    (
        "step",
        {"setpoint": ROW, "setpoint_rate": ROW, "setpoint_acceleration": np.zeros(3)},
        "setpoint_acceleration",
    ),
    ("step", {"setpoint": ROW, "substeps": 0}, "substeps"),
    ("rollout", {"setpoints": ROW}, "setpoints"),
    ("rollout", {"setpoints": np.zeros((4, 3, DOF))}, "setpoints"),
    ("reset", {"mask": [True]}, "mask"),
    ("reset", {"seed": 0}, "seed"),
    ("reset", {"base_pose": np.zeros(7)}, "base_pose"),
    ("reset", {"base_twist": np.zeros(6)}, "base_twist"),
    ("bodies", {"names": ["ball"]}, "names"),
    ("params", {"value": load_bundled("panda").params()}, "params"),
    ("actuators", {"value": bp.make_actuators(3, strength=0.9)}, "actuators"),
]


@pytest.fixture(scope="module")
def runner() -> Any:
    with Runner(ARM, N, workers=0, substeps=2) as made:
        yield made


def call(runner: Runner, name: str, arguments: dict[str, Any]) -> str:
    """Make a wrong call; check that it changes nothing, and return the name of the argument in its
    error.
    """
    before, time = runner.observe(), runner.time
    act = (lambda: setattr(runner, name, arguments["value"])) if "value" in arguments else None
    argument = named(act or (lambda: getattr(runner, name)(**arguments)))
    assert_identical(runner.observe(), before)
    assert runner.time == time
    assert runner.step(ROW if runner.robot.fixed_base else runner.robot.start).ok.all()
    return argument


@pytest.mark.parametrize(("name", "arguments", "argument"), CALLS, ids=label)
def test_a_refused_call_names_its_argument(
    runner: Runner, name: str, arguments: dict[str, Any], argument: str
) -> None:
    assert argument.removesuffix("s") in call(runner, name, arguments)


@pytest.mark.parametrize(
    ("arguments", "argument"),
    [
        ({"base_pose": np.zeros(7)}, "base_pose"),
        ({"base_pose": np.zeros(3)}, "base_pose"),
        ({"base_twist": [0, 0, np.nan, 0, 0, 0]}, "base_twist"),
        *(({"seed": seed}, "seed") for seed in (-1, 0.5, [1, 2, 3], [-1] * N)),
    ],
)
def test_a_refused_reset_of_a_floating_base_names_its_argument(
    arguments: dict[str, Any], argument: str
) -> None:
    drawn = Randomization(payload=Uniform(0, 1))
    with Runner(FREE, N, workers=0, engine="mujoco", ground=False, randomization=drawn) as runner:
        assert call(runner, "reset", arguments) == argument


@pytest.mark.parametrize(
    "options", [{"params": ARM.params(kp=9.0)}, {"control": "drive"}, {"control": "effort"}]
)
def test_an_acceleration_that_no_gain_uses_is_refused(options: dict[str, Any]) -> None:
    with Runner(ARM, N, workers=0, **options) as runner:
        given = {"setpoint_rate": ROW, "setpoint_acceleration": ROW}
        assert call(runner, "step", {"setpoint": ROW, **given}) == "setpoint_acceleration"
        given = {f"{name}s": rows[None] for name, rows in given.items()}
        assert (
            call(runner, "rollout", {"setpoints": ROW[None], **given}) == "setpoint_accelerations"
        )


def test_a_refused_command_of_entries_names_the_entry() -> None:
    control = Hold(command=CommandSpec(("x", "y", "z")))
    bad = np.zeros((N, 3))
    bad[1, 2] = np.nan
    with Runner(ARM, N, workers=0, control=control) as runner:
        with pytest.raises(InvalidArgumentError) as caught:
            runner.step(bad)
        assert (
            caught.value.argument,
            caught.value.entry,
            caught.value.joint,
            caught.value.env,
        ) == (
            "setpoint",
            "z",
            None,
            1,
        )
        for arguments, argument in (
            ({"setpoint": np.zeros((N, 2))}, "setpoint"),
            ({"setpoint": np.zeros(3), "setpoint_rate": np.zeros(2)}, "setpoint_rate"),
            ({"setpoint": np.zeros(3), "feedforward": np.zeros(3)}, "feedforward"),
        ):
            assert named(lambda arguments=arguments: runner.step(**arguments)) == argument
        assert runner.step(np.zeros(3)).ok.all()


# -- constructors

MADE: list[tuple[Callable[..., Any], dict[str, Any], str]] = [
    *(
        (Ray, options, next(iter(options)))
        for options in ({"address": "ray://host:1"}, {"nodes": 0}, {"cpus_per_node": 0.5})
    ),
    *(
        (lambda **options: CommandSpec(("x", "y"), **options), options, argument)
        for options, argument in (
            ({"units": ("m",)}, "units"),
            ({"neutral": (0, 1, 2)}, "neutral"),
            ({"neutral": (np.inf, 0)}, "neutral"),
        )
    ),
    (ARM.guard, {"rate": -1.0}, "rate"),
    (Robot.load, {"name_or_path": "panda", "dissipation": "none"}, "dissipation"),
    (OperationalSpace, {"robot": ARM, "link": "foot"}, "link"),
]


@pytest.mark.parametrize(("make", "options", "argument"), MADE)
def test_refused_constructors_name_their_argument(
    make: Callable[..., Any], options: dict[str, Any], argument: str
) -> None:
    assert argument in named(lambda: make(**options))


@pytest.mark.parametrize("arguments", [("run.txt",), (3,), ("run.h5", None)])
def test_a_recorder_that_is_refused_is_not_attached(runner: Runner, arguments: Any) -> None:
    path, recorded = (*arguments, runner)[:2]
    with pytest.raises(BatchPIDError):
        Recorder(path, recorded)
    assert runner.recorder is None
