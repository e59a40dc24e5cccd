import inspect
import json
import os
import runpy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from robots import load_bundled

import batchpid as bp
from batchpid.sim import Robot, Runner
from batchpid.sim.cli import main
from batchpid.sim.identification import Log, LogWarning, excite, identify, read_logs

pytest.importorskip("scipy")
EXAMPLE = Path(__file__).parents[4] / "examples/mujoco_log.py"
DT = 1 / 1000
"""Time step of the logs of ``runs``: half the sim steps of the default."""
PER_JOINT = ("armature", "damping", "friction", "strength", "bias")
ARM = """<robot name="arm2"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/>
<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.005"/></inertial></link>
<link name="fore"><inertial><origin xyz="0 0 0.15"/><mass value="1"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.002"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.5"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="40" velocity="6"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="20" velocity="6"/></joint></robot>"""

PENDULUM = """<robot name="pendulum"><link name="base"/>
<link name="bob"><inertial><origin xyz="0 0 -0.3"/><mass value="2"/>
<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.005"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="bob"/><origin xyz="0 0 0.5"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="40" velocity="6"/></joint></robot>"""


def several_joints(count: int, fixed: int | None = None) -> str:
    """Return the URDF of an arm of up to six joints, j0 and so on, one of which may be fixed at 0."""
    parts, above = ['<robot name="arm"><link name="l0"/>'], 0.1
    sizes = [(4, 0.2, 150), (5, 0.4, 150), (3, 0.35, 100), (1.5, 0.1, 30), (1.2, 0.1, 30), (0.5, 0.08, 15)]
    for number, (mass, length, effort) in enumerate(sizes[:count]):
        axis, kind = "0 0 1" if number in (0, 4) else "0 1 0", "fixed" if number == fixed else "revolute"
        across = mass * (length**2 / 12 + 0.002)
        tensor = f'ixx="{across}" iyy="{across}" izz="{0.003 * mass}" ixy="0" ixz="0" iyz="0"'
        inertial = f'<origin xyz="0.01 0 {length / 2}"/><mass value="{mass}"/><inertia {tensor}/>'
        ends = f'<parent link="l{number}"/><child link="l{number + 1}"/><origin xyz="0 0 {above}"/><axis xyz="{axis}"/>'
        limit = f'<limit lower="-2.5" upper="2.5" effort="{effort}" velocity="4"/>'
        parts.append(f'<link name="l{number + 1}"><inertial>{inertial}</inertial></link>')
        parts.append(f'<joint name="j{number}" type="{kind}">{ends}{limit}</joint>')
        above = length
    return "".join([*parts, "</robot>"])


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> Robot:
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(ARM)
    return Robot.load(path)


@pytest.fixture(scope="module")
def mujoco_log():
    pytest.importorskip("mujoco")
    return runpy.run_path(str(EXAMPLE))


def as_log(robot: Robot, table: dict, kind: str) -> Log:
    joints = tuple(range(robot.dof))
    return Log("log", joints, kind, table["time"], table["qpos"], table["time"], table[kind], False)


@pytest.fixture(scope="module")
def runs(arm, mujoco_log):
    """Truth, and logs of 2.5 s of setpoints and of efforts."""
    truth, params = mujoco_log["plausible"](arm, 1), arm.designed("effort")
    table = mujoco_log["simulate"](arm, truth, excite(arm, 2.5, lowest=0.6), params, timestep=DT, every=1, seed=1)
    return truth, as_log(arm, table, "setpoint"), as_log(arm, table, "effort")


@pytest.fixture
def short_search(monkeypatch):
    """The search has few steps: one hypothesis of the compensation, one generation, short fits of neighbours."""
    monkeypatch.setattr("batchpid.sim.identification.fit_search.hypotheses", lambda drive, payload: [drive])
    monkeypatch.setattr("batchpid.sim.identification.fit_search.GENERATIONS", 1)
    monkeypatch.setattr("batchpid.sim.identification.fit_search.NEIGHBOUR_EVALUATIONS", 2)


def error_of_the_export(found, truth, motion, params: bp.PIDParams, folder: Path) -> tuple[float, float]:
    """Return the errors of a robot of ideal motors and of the identified motors as MJCF, in MuJoCo under the law [rad].

    The truth is a log without noise.
    """
    import mujoco

    robot, still = found.robot, truth._replace(noise=0.0)
    wanted = runpy.run_path(str(EXAMPLE))["simulate"](robot, still, motion, params, timestep=DT, every=1)
    found.save(folder / "motors.yaml")
    words = ["export", str(robot.path), "--to", "mjcf", "--motors", "--timestep", str(DT)]
    words, errors = [*words, "--out", str(folder / "a.xml")], []
    for motors in ([], ["--actuators", str(folder / "motors.yaml"), "--force"]):
        assert not main([*words, *motors])
        model = mujoco.MjModel.from_xml_path(str(folder / "a.xml"))
        data, pid = mujoco.MjData(model), bp.BatchPID(params.replace(measurement_rate="difference"), 1, dt=DT)
        order, moved = [int(model.joint(name).qposadr[0]) for name in robot.joint_names], []
        data.qpos[order] = wanted["setpoint"][0]
        for setpoint in wanted["setpoint"]:
            mujoco.mj_forward(model, data)
            moved.append(data.qpos[order])
            data.ctrl[:] = pid(setpoint[None], data.qpos[order][None])[0]
            data.qfrc_applied[:] = data.qfrc_bias
            mujoco.mj_step(model, data)
        errors.append(float(np.sqrt(np.mean((np.array(moved) - wanted["qpos"]) ** 2))))
    return errors[0], errors[1]


@pytest.mark.parametrize("kind", [pytest.param("setpoint", marks=pytest.mark.slow), "effort"])
def test_known_motors_are_found(arm, runs, kind, tmp_path):
    truth, setpoints, efforts = runs
    by_law = kind == "setpoint"
    found = identify(
        arm,
        setpoints if by_law else efforts,
        params=arm.designed("effort") if by_law else None,
        timestep=DT,
        workers=0,
        payload=False,
    )
    document = json.loads(json.dumps(found.document()))
    known = inside = 0
    for index, joint in enumerate(arm.joint_names):
        for name in PER_JOINT:
            estimate, low, high = document["joints"][joint][name]
            if estimate is None:
                continue
            known += 1
            assert low < estimate < high
            wanted = float(getattr(truth, name)[index])
            assert abs(estimate - wanted) < 0.05 * abs(wanted) + (high - low) / 2, (joint, name)
            inside += low <= wanted <= high
    assert document["delay"][0] == pytest.approx(truth.delay, abs=2e-4)
    before, after = document["held_out_error"]
    assert after < before / 10
    assert known >= 9
    assert inside >= known - 1
    actuators = found.actuators()
    assert actuators.command_delay[0, 0] == pytest.approx(document["delay"][0])
    assert actuators.coulomb[0, 0] == pytest.approx(document["joints"]["shoulder"]["friction"][0])
    if by_law:
        motion = excite(arm, 2.5, lowest=0.6)
        ideal, identified = error_of_the_export(found, truth, motion, arm.designed("effort"), tmp_path)
        assert identified < 0.1 * ideal


def test_a_joint_that_did_not_move_is_left_out_by_name(mujoco_log, tmp_path):
    (tmp_path / "turret.urdf").write_text(ARM.replace('<axis xyz="0 1 0"/>', '<axis xyz="0 0 1"/>', 1))
    turret = Robot.load(tmp_path / "turret.urdf")  # pitching its upper joint does not turn the lower one
    truth, params = mujoco_log["plausible"](turret, 2), turret.designed("effort")
    motion = excite(turret, 1.6, lowest=0.6)
    still = motion._replace(position=np.where([False, True], motion.position, motion.position[0]))
    table = mujoco_log["simulate"](turret, truth, still, params, timestep=DT, every=1, compensate=False)
    log = as_log(turret, table, "setpoint")
    options = {"params": params, "timestep": DT, "compensate": "none", "workers": 0, "payload": False}
    with pytest.warns(LogWarning, match="'shoulder' did not move: left out"):
        found = identify(turret, log, **options, evaluations=3)
    assert found.joints == (1,)
    assert found.explains
    assert "elbow: friction" not in found.not_identified
    found.save(tmp_path / "motors.yaml")
    saved = yaml.safe_load((tmp_path / "motors.yaml").read_text())["about"]
    assert saved["did_not_move_hence_ideal"] == ["shoulder"]
    assert saved["not_in_the_logs_hence_ideal"] == []
    of_joints, others = found.missing()
    assert saved["not_well_determined"] == of_joints | ({"all joints": others} if others else {})
    loaded = Robot.load(turret.path, actuators=tmp_path / "motors.yaml").actuators
    assert loaded.armature[0, 0] == 0.0
    for name, leaf in found.actuators()._asdict().items():  # every value, however uncertain
        assert leaf is None or np.array_equal(leaf, getattr(loaded, name)), name
    unknown = [("strength", 1, "0 to 0"), ("strength", -1, "0 to 0"), ("strength", None, "0 to 0")]
    unknown += [("mass", 0, "armature"), ("payload", None, "delay"), ("delay", 0, "leave it out")]
    for kind, joint, message in unknown:
        with pytest.raises(bp.InvalidArgumentError, match=message):
            found.interval(kind, joint)
    stuck = replace(log, qpos=np.tile(log.qpos[:1], (len(log.qpos), 1)))
    with pytest.raises(bp.InvalidArgumentError, match="no motion of any joint"):
        identify(turret, stuck, **options)


@pytest.mark.parametrize(
    ("kind", "asked", "gives"),
    [
        ("effort", True, 0.0),
        pytest.param("effort", False, 0.0, marks=pytest.mark.slow),
        *(
            pytest.param("setpoint", asked, gives, marks=pytest.mark.slow)
            for asked, gives in ((True, 0.0), (False, 0.0), (True, 1e-3))
        ),
    ],
)
@pytest.mark.usefixtures("short_search")
def test_a_joint_of_three_that_stuck_does_not_spoil_the_others(mujoco_log, tmp_path, kind, asked, gives):
    """With its columns, where its commands move or rest, the other joints are explained as well as on a robot that has
    a fixed joint in its place; also if it gives by 1 mrad in proportion to its setpoint.
    """
    stuck, rest = 1, [0, 2]
    for name, fixed in (("three", None), ("two", stuck)):
        (tmp_path / f"{name}.urdf").write_text(several_joints(3, fixed))
    three, two = (Robot.load(tmp_path / f"{name}.urdf") for name in ("three", "two"))
    truth, params = mujoco_log["plausible"](three, 0), three.designed("effort")
    motion = excite(three, 1.0, lowest=1.0)
    of_two = truth._replace(**{name: getattr(truth, name)[rest] for name in PER_JOINT})
    moved = type(motion)(motion.time, *(leaf[:, rest] for leaf in motion[1:]))
    table = mujoco_log["simulate"](two, of_two, moved, params.for_joints(rest), timestep=DT, every=1, compensate=False)
    time, rows = table["time"], len(table["time"])
    setpoint = np.interp(time, motion.time - motion.time[0], motion.position[:, stuck]) * asked
    qpos, command = np.zeros((2, rows, 3))
    qpos[:, rest], command[:, rest] = table["qpos"], table[kind]
    qpos[:, stuck] = 2e-5 * np.random.default_rng(1).standard_normal(rows)
    qpos[:, stuck] += gives * (setpoint - setpoint.mean()) / max(setpoint.std(), 1e-9)
    command[:, stuck] = setpoint if kind == "setpoint" else 50.0 * (setpoint - qpos[:, stuck])
    options = {"timestep": DT, "compensate": "none", "workers": 0, "payload": False, "evaluations": 2}
    by_law = kind == "setpoint"
    alone = identify(two, as_log(two, table, kind), params=params.for_joints(rest) if by_law else None, **options)
    log = Log("log", tuple(range(3)), kind, time, qpos, time, command, False)
    with pytest.warns(LogWarning, match=f"'j1' did not {'follow its setpoint' if gives else 'move'}: left out"):
        found = identify(three, log, params=params if by_law else None, **options)
    assert found.joints == tuple(rest)
    assert alone.held_out_error[1] < 0.1 * alone.held_out_error[0]
    for with_it, without in zip(found.held_out_error, alone.held_out_error, strict=True):
        assert with_it == pytest.approx(without, rel=0.05)


@pytest.mark.slow
def test_the_way_of_the_compensation_is_judged_by_the_motion(arm, mujoco_log):
    """The regression alone takes the compensation of this log for one outside of the motors."""
    rng, params = np.random.default_rng(100), arm.designed("effort")
    strength, delay = np.round(rng.uniform(0.75, 1.1, 2), 3), float(rng.uniform(0.0, 0.006))
    truth = mujoco_log["plausible"](arm, 23)._replace(strength=strength, delay=delay, noise=1e-4)
    motion = excite(arm, 3.0, lowest=0.6)
    table = mujoco_log["simulate"](arm, truth, motion, params, seed=23, timestep=1e-3, every=1, through=True)
    log = as_log(arm, table, "setpoint")
    found = identify(arm, log, params=params, workers=0, timestep=1e-3, payload=False)
    assert found.drive.through
    assert found.explains
    inside = [
        low <= getattr(truth, kind)[joint] <= high
        for kind in PER_JOINT
        for joint in range(2)
        if (row := found.interval(kind, joint)) is not None
        for _, low, high in [row]
    ]
    assert len(inside) >= 4
    assert all(inside)


@pytest.mark.slow
@pytest.mark.usefixtures("short_search")
def test_a_fit_resumes_where_it_stopped(arm, runs, tmp_path):
    _, setpoints, _ = runs
    time, qpos, command = (table[1000:1210] for table in (setpoints.time, setpoints.qpos, setpoints.command))
    log = Log("part", (0, 1), "setpoint", time, qpos, time, command, False)
    options = {"params": arm.designed("effort"), "timestep": DT, "workers": 0, "payload": False, "evaluations": 3}
    seen = []  # of each fit: the compensation may have several

    def watch(steps):
        seen.append([])
        for step in steps:
            seen[-1].append(step)
            yield step

    whole = identify(arm, log, **options, progress=watch)

    def stop(steps, last):
        for step in steps:
            if step == last:
                raise KeyboardInterrupt
            yield step

    history = tmp_path / "fit.json"
    for last in (1, len(seen[0]) - 1):  # the second while the fit with noise runs, in a fit that has resumed once
        with pytest.raises(KeyboardInterrupt):
            identify(arm, log, **options, history=history, progress=partial(stop, last=last))
    resumed = identify(arm, log, **options, history=history)
    assert np.array_equal(resumed.estimate, whole.estimate)
    assert np.array_equal(resumed.uncertainty.deviation, whole.uncertainty.deviation)
    assert json.loads(history.read_text())["state"]["done"]
    with pytest.raises(bp.InvalidArgumentError, match=r"another fit \(seed differ\)"):
        identify(arm, log, **options, seed=1, history=history)


@pytest.mark.usefixtures("short_search")
def test_a_history_of_other_inputs_is_refused_by_their_names(arm, runs, tmp_path):
    _, setpoints, _ = runs
    time, qpos, command = (table[1000:1210] for table in (setpoints.time, setpoints.qpos, setpoints.command))
    log = Log("part", (0, 1), "setpoint", time, qpos, time, command, False)
    gains, history = arm.designed("effort"), tmp_path / "fit.json"

    def stop(steps):
        raise KeyboardInterrupt
        yield from steps

    def resume(robot: Robot = arm, log: Log = log, **options) -> None:
        fixed = {"params": gains, "timestep": DT, "workers": 0, "payload": False, "evaluations": 1, "history": history}
        identify(robot, log, **{**fixed, **options}, progress=stop)

    with pytest.raises(KeyboardInterrupt):
        resume()

    def refused(names: str, *robot: Robot, **options) -> None:
        with pytest.raises(bp.InvalidArgumentError, match=rf"another fit \({names} differ\)"):
            resume(*robot, **options)

    refused("params", params=gains.replace(kp=gains.kp[:, ::-1]))  # their repr is the same
    (path := tmp_path / "arm.urdf").write_text(ARM)
    with pytest.raises(KeyboardInterrupt):
        resume(Robot.load(path))  # the same content under another path
    path.write_text(ARM.replace('mass value="1"', 'mass value="1.5"'))
    refused("urdf", Robot.load(path))
    refused("data", log=replace(log, qpos=qpos + 1e-12))
    refused("data", log=replace(log, time=time * (1 + 1e-12)))
    refused("data", log=replace(log, held=True))
    refused("evaluations", evaluations=2)


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_number_of_workers(arm, runs):
    options = {"params": arm.designed("effort"), "timestep": DT, "evaluations": 2}
    alone, shared = (identify(arm, runs[1], workers=workers, **options) for workers in (0, 2))
    assert np.array_equal(alone.estimate, shared.estimate)
    assert np.array_equal(alone.uncertainty.deviation, shared.uncertainty.deviation)


@pytest.mark.slow
@pytest.mark.usefixtures("short_search")
def test_a_log_that_no_robot_could_have_made_is_refused(runs, tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM.replace("revolute", "continuous"))
    arm, log = Robot.load(tmp_path / "arm.urdf"), runs[1]
    unstable = bp.make_params(2, kp=1e9, kd=1e9)
    time, qpos, command = (table[1000:1210] for table in (log.time, log.qpos, log.command))
    part = Log("part", (0, 1), "setpoint", time, qpos, time, command, False)
    with pytest.raises(bp.InvalidArgumentError, match="all diverge"):
        identify(arm, part, params=unstable, timestep=DT, workers=0, payload=False)


def test_logs_and_params_have_to_fit(arm, runs):
    _, setpoints, efforts = runs
    with pytest.raises(bp.InvalidArgumentError, match="give the params that drove the robot"):
        identify(arm, setpoints, workers=0)
    with pytest.raises(bp.InvalidArgumentError, match="give no params"):
        identify(arm, efforts, params=arm.designed("effort"), workers=0)
    with pytest.raises(bp.InvalidArgumentError, match="hold 3 joints"):
        identify(arm, setpoints, params=bp.make_params(3, kp=1.0), workers=0)
    with pytest.raises(bp.InvalidArgumentError, match="name one file"):
        identify(arm, [], workers=0)


def test_the_example_writes_a_log_that_reads_back(arm, mujoco_log, runs, tmp_path):
    truth = runs[0]
    table = mujoco_log["simulate"](arm, truth, excite(arm, 1.0), arm.designed("effort"))
    mujoco_log["write"](arm, table, tmp_path / "log.csv")
    (log,) = read_logs(arm, [tmp_path / "log.csv"])
    np.testing.assert_allclose(log.qpos, table["qpos"], atol=1e-8)


@pytest.mark.usefixtures("short_search")
def test_the_intervals_of_several_motors_hold_the_truth(tmp_path):
    """Of a pendulum under sweeps of effort, whose log has the noise of an encoder."""
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    robot, inside = Robot.load(tmp_path / "pendulum.urdf"), []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth = {"armature": rng.uniform(0.01, 0.05), "strength": rng.uniform(0.8, 1.1), "bias": rng.uniform(-0.2, 0.2)}
        log = swept(truth, damping=rng.uniform(0.05, 0.3), noise=1e-4 * rng.standard_normal(1500))
        found = identify(robot, log, compensate="none", timestep=DT, payload=False, workers=0, evaluations=8)
        assert found.explains
        for kind, value in truth.items():
            estimate, low, high = found.interval(kind, 0)
            assert estimate == pytest.approx(value, rel=0.1)
            inside.append(low <= value <= high)
    assert np.mean(inside) >= 0.9


def swept(truth: dict[str, float], damping: float, noise: np.ndarray) -> Log:
    """Return a log of a pendulum, by semi-implicit Euler steps."""
    time = DT * np.arange(len(noise))
    effort, qpos, q, v = 3.0 * np.sin(2 * np.pi * (1 + 1.5 * time) * time), np.empty(len(time)), 0.1, 0.0
    inertia = 0.03 + 2 * 0.3**2 + truth["armature"]
    for row in range(len(time)):
        qpos[row] = q
        force = truth["strength"] * effort[row] + truth["bias"] - 9.81 * 2 * 0.3 * np.sin(q)
        v = (inertia * v + DT * force) / (inertia + DT * damping)
        q += DT * v
    return Log("log", (0,), "effort", time, (qpos + noise)[:, None], time, effort[:, None], True)


@pytest.mark.slow
@pytest.mark.usefixtures("short_search")
@pytest.mark.filterwarnings("ignore::batchpid.sim.MovingSetpointWarning")
def test_a_joint_that_sticks_half_of_the_time_is_identified(tmp_path):
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    robot, time = Robot.load(tmp_path / "pendulum.urdf"), DT * np.arange(4000)
    waves = (0.4 * (np.sin(5 * time) ** 3 + 0.3 * np.sin(21 * time) ** 5))[:, None]
    gains, motors = robot.designed("effort"), bp.make_actuators(1, armature=0.05, viscous=0.2, coulomb=1.0)
    options = {"params": gains, "compensate": "gravity+coriolis", "timestep": DT, "workers": 0}
    with Runner(robot, 1, substeps=1, actuators=motors, **options) as runner:
        begin = runner.reset(waves[:1]).qpos
        qpos = np.concatenate([begin, runner.rollout(waves[:, None]).qpos[:, 0]])[:-1].astype(float)
    assert (np.abs(np.diff(qpos, axis=0)) < 1e-3 * DT).mean() > 0.2
    found = identify(robot, Log("log", (0,), "setpoint", time, qpos, time, waves, False), **options, payload=False)
    for kind, value in {"armature": 0.05, "friction": 1.0, "strength": 1.0}.items():
        assert found.interval(kind, 0)[0] == pytest.approx(value, rel=0.2), kind


@pytest.mark.slow
def test_the_intervals_hold_the_truth(arm, mujoco_log):
    """Of the unknowns that logs of MuJoCo show, with other motors and noise by seed, nine tenths and more."""
    params, motion, inside, worst = arm.designed("effort"), excite(arm, 4.0, lowest=0.3), [], []
    for seed in range(5):
        truth = mujoco_log["plausible"](arm, seed)
        table = mujoco_log["simulate"](arm, truth, motion, params, seed=seed)
        found = identify(arm, [as_log(arm, table, "setpoint")], params=params, workers=0)
        truths = {(kind, joint): getattr(truth, kind)[joint] for kind in PER_JOINT for joint in range(arm.dof)}
        truths[("delay", None)] = truth.delay
        held = []
        for (kind, joint), value in truths.items():
            if (interval := found.interval(kind, joint)) is not None:
                estimate, low, high = interval
                held.append(low <= value <= high)
                worst.append((abs(estimate / value - 1), kind, joint, seed))
        inside.append(np.mean(held))
        assert abs(found.interval("delay")[0] - truth.delay) < 2e-4
        assert found.held_out_error[1] < 0.1 * found.held_out_error[0]
    print(np.round(inside, 2), np.mean(inside), sorted(worst, reverse=True)[:5])
    assert np.mean(inside) >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(int(os.environ.get("BATCHPID_SOAK_SEEDS", "1"))))
@pytest.mark.parametrize(("name", "kind"), [("panda", "setpoint"), ("panda", "effort"), ("jaco2", "setpoint")])
def test_the_motors_of_an_arm_are_found(name, mujoco_log, kind, seed):
    """Its seven arm joints, from ten seconds in MuJoCo."""
    robot = load_bundled(name)
    truth, params = mujoco_log["plausible"](robot, seed), robot.designed("effort")
    every = 2 if kind == "setpoint" else 1  # the noise in efforts between the rows of a log is not known
    table = mujoco_log["simulate"](robot, truth, excite(robot, 10.0), params, moving=7, every=every, seed=seed)
    log = Log("log", tuple(range(7)), kind, table["time"], table["qpos"], table["time"], table[kind], False)
    of_arm = bp.PIDParams(*(leaf[:, :7] if getattr(leaf, "ndim", 0) == 2 else leaf for leaf in params))
    found = identify(robot, log, params=of_arm if kind == "setpoint" else None)
    inside, errors = [], dict.fromkeys(("armature", "damping", "friction", "strength"), 0.0)
    for number in range(7):
        for unknown in errors:
            if (interval := found.interval(unknown, number)) is None:
                continue
            wanted = float(getattr(truth, unknown)[number])
            assert abs(interval[0] - wanted) < 0.05 * wanted, (unknown, number)
            inside.append(interval[1] < wanted < interval[2])
            errors[unknown] = max(errors[unknown], abs(interval[0] / wanted - 1))
    before, after = found.held_out_error
    print(
        name, kind, seed, errors, found.interval("delay"), f"{before / after:.0f} times, {np.mean(inside):.2f} inside"
    )
    assert len(inside) >= (26 if name == "panda" else 18)
    assert sum(inside) >= len(inside) - 2
    assert found.interval("delay")[0] == pytest.approx(truth.delay, abs=2e-4)
    assert found.held_out_error[1] < 0.1 * found.held_out_error[0]


@pytest.mark.slow
def test_motors_that_move_a_mimic_joint_are_found(tmp_path):
    """A follower as heavy as its leader, in MuJoCo."""
    pytest.importorskip("mujoco")
    fore, elbow = ARM[ARM.index('<link name="fore">') :], ARM[ARM.index('<joint name="elbow"') :]
    link = fore[: fore.index("</link>") + 7].replace("fore", "twin")
    joint = elbow[: elbow.index("</joint>")].replace("fore", "twin").replace("elbow", "follower")
    joint = joint.replace("0 0 0.4", "0 0.2 0.4") + '<mimic joint="elbow" multiplier="-1"/></joint>'
    (tmp_path / "arm.urdf").write_text(ARM.replace("</robot>", f"{link}{joint}</robot>"))
    robot = Robot.load(tmp_path / "arm.urdf")
    joints, params = [0, 1], robot.designed("effort")
    truth = bp.make_actuators(
        3, armature=[0.1, 0.03, 0], viscous=[0.5, 0.2, 0], coulomb=[0.6, 0.3, 0], strength=0.9, command_delay=0.004
    )
    motion = np.repeat(excite(robot, 6.0).position, 4, axis=0)  # of 500 Hz
    options = {"params": params, "actuators": truth, "compensate": "gravity+coriolis", "engine": "mujoco"}
    with Runner(robot, 1, workers=0, substeps=1, **options) as runner:
        begin = runner.reset(motion[:1]).qpos
        rollout = runner.rollout(motion[:, None])
    time, qpos = np.arange(len(motion)) / 2000, np.concatenate([begin, rollout.qpos[:, 0]])[:-1]
    log = Log("log", (0, 1), "setpoint", time, qpos[:, joints], time, motion[:, joints], False)
    of_log = bp.PIDParams(*(leaf[:, joints] if getattr(leaf, "ndim", 0) == 2 else leaf for leaf in params))
    found = identify(robot, log, params=of_log, payload=False, workers=0)
    for kind, name in (("armature", "armature"), ("damping", "viscous"), ("friction", "coulomb")):
        for joint in joints:
            wanted = float(getattr(truth, name)[0, joint])
            assert found.interval(kind, joint)[0] == pytest.approx(wanted, rel=0.03), (kind, joint)
    assert found.interval("delay")[0] == pytest.approx(0.004, abs=1e-4)


INPUTS = {
    "robot": lambda arm, log, path: [arm, replace(arm, actuators=bp.make_actuators(2, coulomb=1.0)), heavier(path)],
    "logs": lambda arm, log, path: [log, replace(log, qpos=log.qpos * 1.01), replace(log, held=True), [log, log]],
    "params": lambda arm, log, path: [arm.designed("effort"), arm.designed("effort").replace(ki=None)],
    "compensate": lambda *_: ["gravity+coriolis+friction", "gravity+coriolis", "gravity", "none"],
    "timestep": lambda *_: [DT, DT / 2],
    "sim_steps": lambda *_: [1, 2],
    "payload": lambda *_: [False, True],
    "hold": lambda *_: [False, True],
    "evaluations": lambda *_: [1, 2],
    "seed": lambda *_: [0, 1],
    "workers": lambda *_: [0, 1],
    "progress": lambda *_: [None, list],
}
"""Values of the inputs of a fit to try."""


def heavier(path: Path) -> Robot:
    path.write_text(ARM.replace('mass value="1"', 'mass value="1.5"'))
    return Robot.load(path)


@pytest.mark.slow
@pytest.mark.usefixtures("short_search")
@pytest.mark.parametrize("name", [name for name in inspect.signature(identify).parameters if name != "history"])
def test_a_history_is_refused_or_has_no_effect_under_another_value_of_each_input(arm, runs, tmp_path, name):
    """A new input needs a line in INPUTS. The log is a file for ``hold``, which says how files are read."""
    _, setpoints, _ = runs
    time, qpos, command = (table[1000:1210] for table in (setpoints.time, setpoints.qpos, setpoints.command))
    log: Any = Log("part", (0, 1), "setpoint", time, qpos, time, command, False)
    if name == "hold":
        rows = np.column_stack([time, qpos, command])
        log = tmp_path / "log.csv"
        columns = [f"{kind}:{joint}" for kind in ("qpos", "setpoint") for joint in arm.joint_names]
        np.savetxt(log, rows, delimiter=",", header=",".join(["time", *columns]), comments="")
    base = {"robot": arm, "logs": log, "params": arm.designed("effort"), "timestep": DT, "workers": 0}
    base |= {"payload": False, "evaluations": 1}
    values, results = INPUTS[name](arm, log, tmp_path / "heavier.urdf"), []
    for number, value in enumerate(values):
        found = identify(**{**base, name: value}, history=tmp_path / f"{number}.json")
        results.append((found.estimate, found.uncertainty.deviation))
    for number, value in enumerate(values):
        try:
            found = identify(**{**base, name: value}, history=tmp_path / f"{(number - 1) % len(values)}.json")
        except bp.InvalidArgumentError as error:
            refusal = error
        else:
            refusal = None
            np.testing.assert_array_equal(found.estimate, results[number][0])
            np.testing.assert_array_equal(found.uncertainty.deviation, results[number][1])
        assert refusal is None or refusal.argument == "history"
