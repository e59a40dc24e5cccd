"""Every feature, in each engine, gives the same results on every path: native code, NumPy, JAX,
workers, snapshots, ...

A case is a feature (options of a Runner, in :data:`FEATURES`) in an engine. Its program is a
rollout in which one env fails, a reset of some envs, a snapshot, and another rollout. Each path of
:data:`PATHS` runs this program in another way, and compares the results with :func:`reference`:
native code in this process.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import pickle
import signal
import tempfile
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest
from featured import robot_with
from identical import assert_identical
from option_values import ARM, FRICTION, LINE, MOTORS, NOISE, SENSORS, SIGNALS, box
from robots import load_bundled
from thermal import Thermal
from tiny_urdf import write

import batchpid as bp
from batchpid.sim import (
    CommandSpec,
    LogUniform,
    Normal,
    OperationalSpace,
    Randomization,
    RepairWarning,
    Robot,
    Runner,
    Snapshot,
    Uniform,
    read_recording,
    write_recording,
)
from batchpid.sim.options.options import OPTIONS

N, TICKS, SPLIT, FAILING = 5, 5, 3, 3
"""Envs and ticks of the program, ticks before its snapshot, and the env that fails."""
RESET = np.arange(N) > 2
"""Envs of the reset: none of the first worker, and a part of the first group in this process."""
COPIES = [1, 1, 4, 1, 0]
"""Envs of a snapshot that is restored with other ones."""
ENGINES = ("sapien", "mujoco")
pytestmark = [
    pytest.mark.usefixtures("small_groups"),
    # An env fails and a worker is lost, of which a warning tells; no feature warns of anything else.
    pytest.mark.filterwarnings("error::UserWarning"),
    pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning"),
    pytest.mark.filterwarnings("ignore::batchpid.sim.RecoveryWarning"),
]


class Damped:
    """Controller of the caller's own, for NumPy and JAX: a PD whose damping grows with the number
    of its sim steps.
    """

    def init(self, robot, num_envs, timestep):
        return {"steps": np.zeros(num_envs), "last": (np.zeros((num_envs, robot.dof)), None)}

    def __call__(self, state, setpoint, qpos, qvel, passive):
        steps = state["steps"] + 1
        effort = (
            passive
            + 8.0 * (setpoint - qpos)
            - (1 + 0.01 * steps[:, None]) * qvel
            + 0.1 * state["last"][0]
        )
        return {"steps": steps, "last": (setpoint - qpos, None)}, effort


class Polar(Damped):
    """Controller whose setpoints are a distance and an angle of the shoulder."""

    command = CommandSpec(("distance", "angle"), ("m", "rad"), neutral=(1.0, 0.0))

    def __call__(self, state, setpoint, qpos, qvel, passive):
        xp = setpoint.__array_namespace__()
        elbow = xp.arccos(xp.clip(setpoint[:, 0], -1.0, 1.0))
        goal = xp.stack([setpoint[:, 1] - elbow / 2, elbow], -1)
        return super().__call__(state, goal, qpos, qvel, passive)


class Feature(NamedTuple):
    """Options of a Runner, and properties of its results."""

    options: Any = MappingProxyType({})
    params: Any = None
    """Arguments of ``robot.params()``; None for the gains that the Runner chooses."""
    engines: tuple[str, ...] = ENGINES
    accelerations: bool = False
    repeats: bool = True
    """Whether a second episode is bit-identical: not with noise."""
    exact: bool = False
    """Whether results are bit-identical with and without native code, instead of close; in MuJoCo
    without drives they differ by rounding, since native code has its own steps.
    """
    alike: bool = True
    """Whether the engines agree on the motion: not in contact, nor under large efforts or drives at
    their limits.
    """


EFFORTS = {"kp": 20.0, "ki": 5.0, "kd": 2.0}
LAW = EFFORTS | {
    **{
        "derivative_filter_time": 2e-3,
        "setpoint_weight": 0.7,
        "deadband": 1e-3,
        "effort_rate_limit": 5e3,
    },
    **{
        "anti_windup": "back_calculation",
        "tracking_time": 0.05,
        "integral_limit": 2.0,
        "effort_limit": 4.0,
    },
}
DRAWN = {
    **{
        "payload": Uniform(0, 0.5),
        "link_mass": Uniform(0.7, 1.3, operation="scale"),
        "qvel": Normal(0, 0.1),
    },
    **{
        "center_of_mass": Uniform(-0.01, 0.01),
        "friction": Uniform(0, 0.1),
        "damping": Uniform(0, 0.1),
    },
    **{"armature": LogUniform(1e-3, 0.05), "qpos": Uniform(-0.1, 0.1)},
    "actuators": {"command_delay": Uniform(0, 3e-3, shared=True), "coulomb": Uniform(0, 0.1)},
}
PUSHES = {
    **{
        "push": {"vx": Uniform(0.1, 0.5), "wz": Uniform(-1, 1)},
        "push_interval": Uniform(0.01, 0.03),
    },
    "gravity": {"x": Uniform(-1, 1), "z": Uniform(-1, 1)},
}
SCENE = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
  <body name="arm" pos="0 0 .05"><joint name="turn" axis="0 0 1" damping=".5"/>
    <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
    <body name="tail" pos="-.1 0 0"><joint name="idle" axis="0 1 0"/><geom size=".03" pos="-.1 0 .1"/></body></body>
  <body name="cube" pos=".3 .03 .1"><freejoint/><geom type="box" size=".04 .04 .04"/></body>
  <body name="lamp" pos="-1 0 1" quat="1 .5 0 0"><joint type="ball"/><geom size=".05" pos="0 0 -.1"/></body>
</worldbody><actuator><motor joint="turn" ctrlrange="-20 20"/></actuator></mujoco>"""
"""Arm that pushes a falling cube and has a tail without a motor, beside a lamp that swings."""
EACH = np.arange(1.0, N + 1)[:, None] * [1.0, 0.5]
GUARD = bp.make_guard(2, rate=0.5, acceleration=20.0)
PLAN = bp.make_plan(2, period=0.02, horizon=4, blend="ensemble", acceleration=30.0)
SAPIEN, MUJOCO = ENGINES[:1], ENGINES[1:]


def motors(*effects, joints=2):
    return {
        "actuators": bp.make_actuators(
            joints, **{name: value for each in effects for name, value in each.items()}
        )
    }


def osc(**options):
    return {"control": OperationalSpace(ARM, "hand", **options)}


FEATURES = {
    "default gains": Feature(),
    "accelerations": Feature(accelerations=True),
    "gains in efforts": Feature(params=EFFORTS, exact=True),
    "implicit law": Feature(
        params={
            "gain_units": "mass_matrix",
            "discretization": "implicit",
            "kp": 4e3,
            "ki": 1e4,
            "kd": 120.0,
        }
    ),
    "every option of the law": Feature(params=LAW, exact=True),
    "gains and motors of each env": Feature(
        motors({"strength": EACH / 5, "coulomb": 0.1 * EACH}),
        EFFORTS | {"kp": 10 * EACH, "effort_limit": 3.0 * EACH},
    ),
    "drive": Feature({"control": "drive"}, exact=True),
    "drive with an integral": Feature({"control": "drive"}, EFFORTS, exact=True),
    "efforts": Feature({"control": "effort"}, exact=True),
    "osc": Feature({"control": "osc", "tool": "hand"}),
    "osc with an integral": Feature(osc(integral_gain=20.0, integral_limit=5.0)),
    "implicit osc": Feature(osc(discretization="implicit", point=[0, 0, 0.1], limit_margin=0.2)),
    "own controller": Feature({"control": Damped()}, exact=True),
    "a command of its own": Feature({"control": Polar()}, exact=True),
    "guard": Feature({"guard": GUARD}),
    "plan": Feature({"plan": PLAN, "randomization": Randomization(latency=Uniform(0, 0.03))}),
    "plan of a drive": Feature({"control": "drive", "plan": PLAN, "guard": GUARD}, exact=True),
    "guarded drive": Feature({"control": "drive", "guard": GUARD}, exact=True),
    "a thermal limit": Feature({"stages": [Thermal(2.0, 0.02)]}),
    "motors": Feature(motors(SIGNALS, LINE)),
    "motors with a thermal limit": Feature(
        {"stages": [Thermal(2.0, 0.02)], **motors(SIGNALS, SENSORS)}
    ),
    "sensors": Feature(motors(SENSORS)),
    "noise": Feature(motors(NOISE), repeats=False),
    "friction": Feature(motors(FRICTION)),
    "friction under a drive": Feature(
        {"control": "drive", **motors({"coulomb": 0.2, "armature": 0.02})}
    ),
    "friction under osc": Feature({"control": "osc", **motors({"coulomb": 0.2, "lag": 1e-3})}),
    "friction that the controller knows": Feature({"robot": "worn"}),
    "randomization": Feature({"randomization": Randomization(**DRAWN, seed=3)}),
    "a randomized drive": Feature(
        {"control": "drive", "randomization": Randomization(payload=Uniform(0.1, 0.5))}
    ),
    "compensation of gravity alone": Feature({"compensate": "gravity"}),
    "no compensation": Feature({"compensate": "none", "physics": "fast"}),
    "no collisions": Feature({"collisions": False, "ground": False}),
    "a reset at a fault": Feature({"on_fault": "reset"}),
    "contact sensors": Feature({"contacts": ["hand"]}),
    "wrench sensors": Feature({"wrenches": ["arm"]}, engines=MUJOCO, alike=False),
    "user content": Feature({"build": functools.partial(box, 0.05)}, engines=SAPIEN),
    "objects of a scene": Feature({"robot": "scene"}, engines=MUJOCO, alike=False),
    "links in contact": Feature({"robot": "jaco2", "control": "effort"}, exact=True, alike=False),
    "mimic joints": Feature({"robot": "chain of mimics"}),
    "mimic joints under a drive": Feature({"robot": "mimic", "control": "drive"}, alike=False),
    "mimic joints with motors": Feature(
        {"robot": "sliding mimic", **motors(SIGNALS, FRICTION, joints=9)}
    ),
    "turning mimic joints": Feature({"robot": "sliding mimic of a continuous joint"}),
    "continuous joints": Feature({"robot": "continuous"}),
    "armature": Feature({"robot": "armature"}),
    "floating base": Feature({"robot": "floating base"}),
    "floating base under efforts": Feature(
        {"robot": "floating base", "control": "effort"}, alike=False
    ),
    "pushes": Feature({"robot": "floating base", "randomization": Randomization(**PUSHES)}),
}


def random_feature(seed):
    """Return a control with about half of the effects of motors and sensors, and other options at
    random.
    """
    rng = np.random.default_rng(seed)
    control = ("pid", "effort", "drive")[seed % 3]
    drawn = [each for each in (SIGNALS, SENSORS, LINE, FRICTION) if rng.random() < 0.5]
    effects = [{"coulomb": 0.2, "armature": 0.02}] if control == "drive" else drawn
    compensate = str(rng.choice(["gravity+coriolis+friction", "gravity", "none"]))
    options = {"control": control, "compensate": compensate, **motors(*effects)}
    if control != "effort" and rng.random() < 0.5:
        options["guard"] = GUARD
    if rng.random() < 0.5:
        options["randomization"] = Randomization(
            payload=Uniform(0.0, 0.5), friction=Uniform(0.0, 0.1)
        )
    return Feature(options, LAW if control == "pid" else None)


FEATURES |= {f"random options {seed}": random_feature(seed) for seed in range(9)}


@functools.cache
def robot_of(name):
    """Return a robot by its name in the features; "arm" has two joints, and links with shapes."""
    if name == "arm":
        return ARM
    if name == "scene":
        # Kept, since MuJoCo reads the file again.
        with pytest.warns(RepairWarning):  # of the joint without a motor
            return Robot.load(write(Path(tempfile.mkdtemp()), SCENE, "scene.xml"))
    if name == "worn":
        return dataclasses.replace(ARM, actuators=MOTORS)
    return load_bundled(name) if name in Robot.bundled() else robot_with(name)


def make(case, num_envs=N, **more):
    """Return a runner of a case; ``more`` are further options."""
    feature = FEATURES[case[0]]
    options = {
        "robot": "arm",
        "workers": 0,
        "substeps": 12,
        "timestep": 1e-3,
        "on_invalid_input": "contain",
        "engine": case[1],
    }
    options |= {**feature.options, **more}
    robot = robot_of(options.pop("robot"))
    if not robot.fixed_base:
        options["ground"] = False
    if feature.params is not None:
        options["params"] = robot.params(**feature.params)
    first = options.get("first_env", 0)
    for name in {"params", "actuators"} & options.keys():
        options[name] = options[name].for_envs(slice(first, first + num_envs))
    return Runner(robot, num_envs, **options)


def commands(case, runner):
    """Return the commands of a rollout (TICKS, envs, ...), which are the same for an env in any
    number of envs.
    """
    rng, robot, envs = np.random.default_rng(0), runner.robot, runner.num_envs
    start = runner.observe()
    first = runner.options.first_env
    drawn = rng.uniform(-1, 1, (3, TICKS, N, robot.dof))
    noise, slope, extra = drawn[:, :, first : first + envs]
    if runner.control == "effort":
        setpoint = 0.3 * noise * np.minimum(robot.effort_limit, 50.0)
    elif start.tool_pose is None:
        setpoint = robot.coupling.positions(
            np.clip(robot.start + 0.2 * noise, robot.lower + 1e-3, robot.upper - 1e-3)
        )
    else:
        setpoint = np.tile(start.tool_pose.astype(float), (TICKS, 1, 1))
        setpoint[..., :2] += 0.02 * noise[..., :2]
    given = {"setpoints": setpoint}
    if runner.control in ("pid", "drive"):
        size = 6 if start.tool_pose is not None else robot.dof  # a pose has a twist
        given |= {
            "setpoint_rates": 0.1 * np.tile(slope[..., :1], size),
            "feedforwards": 0.1 * extra,
        }
    if runner.options.plan is not None:  # it makes the rates
        del given["setpoint_rates"]
    if FEATURES[case[0]].accelerations:
        given["setpoint_accelerations"] = slope
    if envs > FAILING:
        setpoint[1, FAILING, 0] = np.nan
    return given


def part(given, ticks):
    return {name: rows[ticks] for name, rows in given.items()}


class Result(NamedTuple):
    """Results of the program."""

    first: Any
    """Rollout before the snapshot."""
    placed: Any
    """Observation of the reset."""
    snapshot: Snapshot
    second: Any
    """Rollout after the snapshot."""
    end: Snapshot
    faults: Any
    poses: Any
    """Poses of the user's content."""


def second_half(runner, given, rollout):
    second = rollout(runner, part(given, slice(SPLIT, None)))
    poses = None if runner.options.build is None else runner.poses()
    return second, runner.snapshot(), runner.faults, poses


def program(runner, case, rollout=None, disturb=None):
    """Run the program; ``disturb`` is called with the runner between the snapshot and the second
    rollout.
    """
    rollout = rollout or (lambda runner, given: runner.rollout(**given))
    given = commands(case, runner)
    first = rollout(runner, part(given, slice(SPLIT)))
    assert_identical(runner.reset(mask=np.zeros(runner.num_envs, bool)), runner.observe())
    placed = runner.reset(mask=RESET[-runner.num_envs :])
    snapshot = runner.snapshot()
    if disturb is not None:
        disturb(runner)
    return Result(first, placed, snapshot, *second_half(runner, given, rollout))


@functools.cache
def reference(case, backend="numpy"):
    """Return the results in this process, with native code."""
    with make(case, backend=backend) as runner:
        result = program(runner, case)
    assert not result.first.ok[1, FAILING]
    assert result.placed.ok.all()
    assert np.ptp(result.first.qpos, axis=0).max() > 1e-4
    return result


def leaves(value, path=""):
    """Yield the arrays and numbers of a result with their paths in it; of a snapshot, states,
    params and steps.
    """
    if value is None or isinstance(value, str | bool | int | float | np.ndarray):
        yield path, value
    elif isinstance(value, Snapshot):
        yield from leaves([value.rows, value.params, value.steps], path)
    elif isinstance(value, dict):
        yield from (leaf for name, each in value.items() for leaf in leaves(each, f"{path}.{name}"))
    elif isinstance(value, list | tuple):
        yield from (
            leaf for number, each in enumerate(value) for leaf in leaves(each, f"{path}.{number}")
        )


def check_equal(ours, theirs):
    """Raise AssertionError unless two results are bit-identical."""
    for name in ("first", "placed", "second"):
        assert_identical(getattr(ours, name), getattr(theirs, name))
    for name in ("snapshot", "end", "faults", "poses"):
        pairs = zip(leaves(getattr(ours, name)), leaves(getattr(theirs, name)), strict=True)
        for (path, mine), (other_path, other) in pairs:
            assert path == other_path
            np.testing.assert_array_equal(mine, other, f"{name}{path}")


def check_close(ours, theirs, atol):
    """Raise AssertionError unless two results are close, and report the same faults."""
    for name in ("first", "second"):
        mine, other = getattr(ours, name), getattr(theirs, name)
        np.testing.assert_allclose(mine.qpos, other.qpos, rtol=0, atol=atol, err_msg=name)
        np.testing.assert_allclose(mine.qvel, other.qvel, rtol=0, atol=300 * atol, err_msg=name)
        np.testing.assert_array_equal(mine.ok, other.ok)
    assert [fault[:2] for fault in ours.faults] == [fault[:2] for fault in theirs.faults]


# -- paths
# --------------------------------------------------------------------------------------------------


def in_python(case):
    """Without native code: NumPy computes the law and its models, and Python calls the engine."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BATCHPID_NATIVE", "0")
        with make(case) as runner:
            assert "native calls into" not in runner.backend
            result = program(runner, case)
    feature = FEATURES[case[0]]
    # Vectors of native code step robots that touch nothing in MuJoCo's place.
    if feature.exact and case[1] != "mujoco":
        check_equal(reference(case), result)
    else:
        check_close(reference(case), result, 1e-7 if feature.exact else 1e-6)


def in_numpy(case):
    """The NumPy executor, with mass matrices and passive forces from native code: bit-identical."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("batchpid.sim.loop.native_executor.runs_natively", lambda setup: False)
        with make(case) as runner:
            check_equal(program(runner, case), reference(case))


def overwrite(arrays):
    for rows in arrays.values():
        rows[...] = 77.0


def tick_by_tick(case):
    """Single ticks are bit-identical to a rollout; arrays of the caller are overwritten after each
    call.
    """

    def rollout(runner, given):
        seen = []
        for tick in range(len(given["setpoints"])):
            row = {name.removesuffix("s"): rows[tick] for name, rows in given.items()}
            seen.append(runner.step(**row))
            overwrite(row)
        return type(seen[0]).join([each.map(lambda rows: rows[None]) for each in seen])

    with make(case) as runner:
        result = program(runner, case, rollout)
    expected = reference(case)
    check_equal(
        result,
        expected._replace(first=expected.first.observation, second=expected.second.observation),
    )


def alone(case):
    """A runner of the last env alone is bit-identical to that env among others."""
    with make(case, num_envs=1, first_env=N - 1) as runner:
        result = program(runner, case)
    for name in ("first", "second"):
        expected = getattr(reference(case), name).for_envs(slice(N - 1, N))
        assert_identical(getattr(result, name), expected)


def restored(case):
    """Another runner continues from a pickled snapshot, bit-identically, and so does each of
    several copies of an env.
    """
    expected = reference(case)
    with make(case) as runner:
        given = commands(case, runner)
        runner.rollout(**part(given, slice(2)))
        snapshot = pickle.loads(pickle.dumps(expected.snapshot))
        runner.restore(snapshot)
        second, end, *_, poses = second_half(
            runner, given, lambda runner, given: runner.rollout(**given)
        )
        runner.restore(snapshot.for_envs(COPIES))
        copies = runner.rollout(**{name: rows[SPLIT:, COPIES] for name, rows in given.items()})
    check_equal(expected._replace(second=second, end=end, poses=poses), expected)
    assert_identical(copies, second.for_envs(COPIES), skip={"time"})


def recorded(case):
    """A recording has the rows of its rollout, and what it was made with."""

    def content(info):
        # A file has no neutral values, which draws may change.
        skipped = {"begun", "urdf", "description", "actuators" if info.draws else ""}
        return [*leaves({name: part for name, part in vars(info).items() if name not in skipped})]

    def rollout(runner, given):
        draws, episodes = runner.draws, runner.episodes
        with tempfile.TemporaryDirectory() as folder:
            run = runner.rollout(**given)
            read = read_recording(write_recording(run, f"{folder}/run.h5"))
        assert read.info.command == runner.command
        expected = dataclasses.replace(run.info, draws=draws, episodes=episodes)
        if runner.options.randomization is None:
            expected = run.info
        for (path, mine), (name, other) in zip(content(read.info), content(expected), strict=True):
            assert path == name
            np.testing.assert_array_equal(mine, other, path)
        return read

    with make(case) as runner:
        check_equal(program(runner, case, rollout), reference(case))


def again(case):
    """A second episode is bit-identical to the first."""
    with make(case) as runner:
        given = commands(case, runner)
        seed = {} if runner.options.randomization is None else {"seed": 0}
        episodes = []
        for _ in range(2):
            runner.reset(**seed)
            episodes.append(runner.rollout(**given))
    assert_identical(*episodes, skip={"time"})


def in_workers(case):
    """Two workers, one of which is killed and replaced; its replay does not see later writes to the
    caller's arrays.
    """

    def rollout(runner, given):
        seen = runner.rollout(**given)
        overwrite(given)
        return seen

    def kill(runner):
        os.kill(runner.pids[1], signal.SIGKILL)

    with make(case, workers=2) as runner:
        result = program(runner, case, rollout, kill)
        assert runner.recoveries == 1
    check_equal(result, reference(case))


def in_jax(case):
    """The control in JAX is close to NumPy, and bit-identical in a worker."""
    check_close(reference(case, "jax"), reference(case), 1e-5)
    with make(case, workers=1, backend="jax") as runner:
        check_equal(program(runner, case), reference(case, "jax"))


def in_the_other_engine(case):
    """The engines agree within 1e-3 rad, without contact."""
    check_close(reference(case), reference((case[0], "sapien")), 1e-3)


PATHS = (
    in_python,
    in_numpy,
    tick_by_tick,
    alone,
    restored,
    recorded,
    again,
    in_workers,
    in_jax,
    in_the_other_engine,
)
QUICK = {in_workers: 5, in_jax: 50}
"""Interval of the quick cases of a path; the others are slow. Other paths have every feature, in
one engine, quick.
"""


def rows():
    for path_number, path in enumerate(PATHS):
        for number, (name, feature) in enumerate(FEATURES.items()):
            for engine in feature.engines:
                if path is again and not feature.repeats:
                    continue
                if path is in_the_other_engine and (not feature.alike or engine == "sapien"):
                    continue
                every = QUICK.get(
                    path, 2 if len(feature.engines) > 1 and path is not in_the_other_engine else 1
                )
                is_quick = (
                    number + ENGINES.index(engine) + (path_number if every == 2 else 0)
                ) % every == 0
                marks = () if is_quick else pytest.mark.slow
                yield pytest.param(
                    path, (name, engine), id=f"{path.__name__}-{name}-{engine}", marks=marks
                )


@pytest.mark.parametrize(("path", "case"), [*rows()])
def test_every_feature_is_the_same_on_every_path(path, case):
    path(case)


def test_every_option_has_a_row():
    """A new option needs a row in FEATURES, unless paths or programs use it."""
    of_paths = {
        "num_envs",
        "first_env",
        "workers",
        "cluster",
        "timeout",
        "engine",
        "backend",
        "params",
    }
    of_programs = {"timestep", "substeps", "on_invalid_input"}
    options = {name for feature in FEATURES.values() for name in feature.options}
    assert options >= OPTIONS.keys() - of_paths - of_programs
