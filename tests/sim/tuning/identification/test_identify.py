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
from batchpid.sim.identification import identify
from batchpid.sim.identification.excitation import excite
from batchpid.sim.identification.fit import FitStep, fit
from batchpid.sim.identification.fit_history import History, State
from batchpid.sim.identification.fit_search import Progress, search
from batchpid.sim.identification.log_noise import split
from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.logs import Log, LogWarning, read_logs
from batchpid.sim.identification.plant import Plant, Segment
from batchpid.sim.identification.problem import Problem
from batchpid.sim.identification.regression import smooth
from batchpid.sim.identification.statistics import LARGEST_MISFIT, uncertainty
from batchpid.sim.identification.unknowns import KINDS, Kind, Motors, Unknowns, take

pytest.importorskip("scipy")
EXAMPLE = Path(__file__).parents[4] / "examples/mujoco_log.py"
DT = 1 / 1000
"""Time step of the logs of ``runs``: half the sim steps of the default."""
PER_JOINT = [name for name, kind in KINDS.items() if kind.per_joint]
ARM = """<robot name="arm2"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/>
<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.005"/></inertial></link>
<link name="fore"><inertial><origin xyz="0 0 0.15"/><mass value="1"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.002"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.5"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="40" velocity="6"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="20" velocity="6"/></joint></robot>"""


def six_joints(fixed: int | None = None) -> str:
    """Return the URDF of an arm of six joints, j0 to j5, one of which may be fixed at 0."""
    parts = ['<robot name="arm6"><link name="l0"/>']
    sizes = [(4, 0.2, 150), (5, 0.4, 150), (3, 0.35, 100), (1.5, 0.1, 30), (1.2, 0.1, 30), (0.5, 0.08, 15)]
    above = 0.1
    for number, (mass, length, effort) in enumerate(sizes):
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
    monkeypatch.setattr("batchpid.sim.identification.regression.hypotheses", lambda drive, payload: [drive])
    monkeypatch.setattr("batchpid.sim.identification.start.GENERATIONS", 1)
    monkeypatch.setattr("batchpid.sim.identification.fit_search.NEIGHBOUR_EVALUATIONS", 2)


def error_of_the_export(found, log: Log, params: bp.PIDParams, dt: float) -> float:
    """Return the error on the held-out rows of the identified motors as MJCF, in MuJoCo under the law [rad].

    The law is given the noise of the log, as in the fit, since it shakes the robot.
    """
    import mujoco

    from batchpid.sim.engine.mujoco.mjcf_export import to_mjcf

    robot, moving = found.robot, list(log.joints)
    model = mujoco.MjModel.from_xml_string(to_mjcf(robot, None, dt, actuators=found.actuators()).text)
    data, pid = mujoco.MjData(model), bp.BatchPID(params.replace(measurement_rate="difference"), 1, dt=dt)
    order = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
    time = np.arange(round(log.time[-1] / dt) + 1) * dt
    wanted = np.zeros((len(time), robot.dof))  # the other joints are locked at 0 in the log
    wanted[:, moving] = log.commands_at(time)
    noise = np.zeros_like(wanted)
    noise[:, moving] = split(log.time, log.qpos, time)[1].values
    data.qpos[order] = wanted[0]
    moved = []
    for setpoint, error in zip(wanted, noise, strict=True):
        mujoco.mj_forward(model, data)
        moved.append(data.qpos[order][moving])
        data.ctrl[:] = pid(setpoint[None], (data.qpos[order] + error)[None])[0]
        data.qfrc_applied[:] = data.qfrc_bias
        mujoco.mj_step(model, data)
    held_out = np.concatenate([fit.time[~fit.fitted] for fit in found.fits])
    steps, held_out = (np.rint(each / dt).astype(int) for each in (log.time, held_out))
    errors = np.array(moved)[steps] - log.qpos
    return float(np.sqrt(np.mean(errors[np.isin(steps, held_out)] ** 2)))


def row(value) -> np.ndarray:
    return np.atleast_2d(np.asarray(value, float))


def motors_of(*values) -> Motors:
    """Return one candidate, from the values of all kinds in the order of the table."""
    return dict(zip(KINDS, map(row, values), strict=True))


def test_the_plant_moves_as_mujoco(arm, mujoco_log):
    truth, params = mujoco_log["plausible"](arm, 3)._replace(noise=0.0), arm.designed("effort")
    table = mujoco_log["simulate"](arm, truth, excite(arm, 1.0, lowest=0.6), params, every=1)
    per_joint = [getattr(truth, kind) for kind in PER_JOINT]
    motors = motors_of(*per_joint, truth.delay, 0.0095, 0.0)
    for kind in ("setpoint", "effort"):
        plant = Plant(arm, (0, 1), LoggedDrive(1 / 2000, params if kind == "setpoint" else None, "gravity+coriolis"))
        segment = Segment(table["qpos"][0], np.zeros(2), table[kind], np.zeros((len(table[kind]), 2)))
        moved = plant.simulate(motors, [segment], 0)[0, :-1]
        np.testing.assert_allclose(moved, table["qpos"], atol=2e-5 if kind == "setpoint" else 2e-4)


@pytest.mark.slow
def test_a_stronger_motor_with_more_inertia_moves_one_joint_alike(arm):
    """The change of a strength for finite differences moves a joint only by its coupling to others."""
    inertia = Plant(arm, (1,), LoggedDrive(1 / 2000, None, "gravity+coriolis")).mass_matrix(
        np.zeros((1, 1)), np.zeros((1, 1))
    )
    unknowns = Unknowns.of(inertia[0, 0], np.array([0.02]), np.ones(1), np.ones(1), payload=False)
    theta = unknowns.point(motors_of(0.02, 0.1, 0.2, 0.9, 0.05, 0.004, 0.005, 0.0))
    changes = unknowns.changes(theta)
    assert np.linalg.matrix_rank(changes / unknowns.scale) == len(theta)
    params = bp.make_params(1, kp=40.0, ki=10.0, kd=2.0)
    plant = Plant(arm, (1,), LoggedDrive(1 / 2000, params, "gravity+coriolis"))
    command = 0.3 * np.sin(9.0 * np.arange(2000) / 2000)[:, None]
    segment = Segment(np.zeros(1), np.zeros(1), command, np.zeros_like(command))
    moved = [
        plant.simulate(unknowns.motors(point[None]), [segment], 0)[0]
        for point in (theta, theta + changes[unknowns.names.index(("strength", 0))])
    ]
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-9)


@pytest.mark.slow
def test_a_search_leaves_a_delay_that_is_best_nearby_only(arm, runs):
    truth, _, efforts = runs
    joints, drive = (0, 1), LoggedDrive(DT, None, "gravity+coriolis")
    unknowns = Unknowns.of(*(np.ones(2) for _ in range(4)), payload=False)
    problem = Problem(arm, joints, drive, [efforts], [smooth(efforts, DT)], unknowns)
    per_joint = [getattr(truth, kind) for kind in PER_JOINT]
    theta = unknowns.point(motors_of(*per_joint, truth.delay + 7e-4, 0.0095, 0.0))
    begin, delay = State(FitStep.first(theta, 20)), unknowns.names.index(("delay", None))
    same, found = search([problem], begin, 20, History(None, {}), Progress(1, 20, None))
    assert same is problem
    assert found.theta[delay] == pytest.approx(truth.delay, abs=1e-4)


@pytest.mark.slow
def test_a_slow_control_is_simulated_in_smaller_steps(arm, mujoco_log):
    truth, params = mujoco_log["plausible"](arm, 1), arm.designed("effort")
    motion = excite(arm, 1.0, rate=2000.0, lowest=1.0).position
    per_joint = [getattr(truth, kind) for kind in PER_JOINT]
    motors = motors_of(*per_joint, truth.delay, 0.005, 0.0)
    drive = LoggedDrive(1 / 2000, params, "gravity+coriolis", substeps=4)
    segment = Segment(motion[0], np.zeros(2), motion, np.zeros_like(motion))
    qpos = Plant(arm, (0, 1), drive).simulate(motors, [segment], 0)[0, :-1:4]
    time = np.arange(len(qpos)) / 500
    noisy = qpos + 1e-5 * np.random.default_rng(0).standard_normal(qpos.shape)
    log = Log("log", (0, 1), "setpoint", time, noisy, time, motion[::4], False)
    options = {"params": params, "timestep": 1 / 500, "workers": 0, "payload": False}
    delays = [identify(arm, log, **options, sim_steps=steps).interval("delay")[0] for steps in (4, 1)]
    assert delays[0] == pytest.approx(truth.delay, abs=5e-5)
    assert delays[1] == pytest.approx(truth.delay + 7.5e-4, abs=1e-4)  # half of what the effort holds longer


def test_rows_of_a_simulation_do_not_depend_on_their_company(arm):
    plant = Plant(arm, (0, 1), LoggedDrive(1 / 2000, arm.designed("effort"), "gravity"))
    rng = np.random.default_rng(0)
    leaves = [rng.uniform(0.1, 1.0, (3, 2)) for _ in PER_JOINT]
    leaves += [*rng.uniform(0.002, 0.01, (2, 3, 1)), np.array([[0.0], [0.3], [0.3]])]
    motors = dict(zip(KINDS, leaves, strict=True))
    segments = [
        Segment(q, np.zeros(2), np.tile(q + 0.2, (50, 1)), np.zeros((50, 2))) for q in rng.uniform(-1, 1, (3, 2))
    ]
    together = plant.simulate(motors, segments, 0)
    for k in range(3):
        assert np.array_equal(plant.simulate(take(motors, [k]), [segments[k]], 0)[0], together[k])


@pytest.mark.parametrize("kind", [pytest.param("setpoint", marks=pytest.mark.slow), "effort"])
def test_known_motors_are_found(arm, runs, kind):
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
        assert error_of_the_export(found, setpoints, arm.designed("effort"), DT) < 2 * after


@pytest.mark.usefixtures("short_search")
def test_an_effect_of_the_motors_is_identified_by_a_line_in_the_table(arm, monkeypatch, tmp_path):
    """Here the lag: from a log of the Runner, and in the file that is saved."""
    monkeypatch.setitem(KINDS, "lag", Kind("lag", True, 1e-3, 0.1, 5e-3, 20.0, 5e-3))
    truth, params = [0.006, 0.012], arm.designed("effort").replace(setpoint_weight=1.0)
    plain = {"armature": [0.1, 0.03], "viscous": [0.5, 0.2], "command_delay": 0.003}
    motion = excite(arm, 1.6, rate=1000.0, lowest=0.6).position
    options = {"params": params, "compensate": "none", "timestep": DT, "workers": 0}
    with Runner(arm, 1, substeps=1, **options, actuators=bp.make_actuators(2, **plain, lag=truth)) as runner:
        begin = runner.reset(motion[:1]).qpos
        qpos = np.concatenate([begin, runner.rollout(motion[:, None]).qpos[:, 0]])[:-1]
    time = DT * np.arange(len(qpos))
    log = Log("log", (0, 1), "setpoint", time, qpos, time, motion, False)
    found = identify(arm, log, **options, payload=False, evaluations=12)
    for joint, wanted in enumerate(truth):
        assert found.interval("lag", joint)[0] == pytest.approx(wanted, rel=0.1)
    found.save(tmp_path / "motors.yaml")
    saved = bp.load_actuators(tmp_path / "motors.yaml", arm.joint_names)[0]
    np.testing.assert_allclose(saved.lag[0], truth, rtol=0.1)


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
def test_a_joint_of_six_that_stuck_does_not_spoil_the_others(mujoco_log, tmp_path, kind, asked, gives):
    """With its columns, where its commands move or rest, the other joints are explained as well as on a robot that has
    a fixed joint in its place; also if it gives by 1 mrad in proportion to its setpoint.
    """
    stuck, rest = 2, [0, 1, 3, 4, 5]
    for name, fixed in (("six", None), ("five", stuck)):
        (tmp_path / f"{name}.urdf").write_text(six_joints(fixed))
    six, five = (Robot.load(tmp_path / f"{name}.urdf") for name in ("six", "five"))
    truth, params = mujoco_log["plausible"](six, 0), six.designed("effort")
    motion = excite(six, 1.0, lowest=1.0)
    of_five = truth._replace(**{name: getattr(truth, name)[rest] for name in PER_JOINT})
    moved = type(motion)(motion.time, *(leaf[:, rest] for leaf in motion[1:]))
    table = mujoco_log["simulate"](
        five, of_five, moved, params.for_joints(rest), timestep=DT, every=1, compensate=False
    )
    time, rows = table["time"], len(table["time"])
    setpoint = np.interp(time, motion.time - motion.time[0], motion.position[:, stuck]) * asked
    qpos, command = np.zeros((2, rows, 6))
    qpos[:, rest], command[:, rest] = table["qpos"], table[kind]
    qpos[:, stuck] = 2e-5 * np.random.default_rng(1).standard_normal(rows)
    qpos[:, stuck] += gives * (setpoint - setpoint.mean()) / max(setpoint.std(), 1e-9)
    command[:, stuck] = setpoint if kind == "setpoint" else 50.0 * (setpoint - qpos[:, stuck])
    options = {"timestep": DT, "compensate": "none", "workers": 0, "payload": False, "evaluations": 2}
    by_law = kind == "setpoint"
    alone = identify(five, as_log(five, table, kind), params=params.for_joints(rest) if by_law else None, **options)
    log = Log("log", tuple(range(6)), kind, time, qpos, time, command, False)
    with pytest.warns(LogWarning, match=f"'j2' did not {'follow its setpoint' if gives else 'move'}: left out"):
        found = identify(six, log, params=params if by_law else None, **options)
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
    assert found.misfit < LARGEST_MISFIT
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
def test_joints_that_noise_alone_shakes_tell_nothing(arm, runs):
    truth, _, efforts = runs
    unknowns = Unknowns.of(*(np.ones(2) for _ in range(4)), payload=False)
    drive, motion = LoggedDrive(DT, None, "gravity+coriolis"), smooth(efforts, DT)
    problem = Problem(arm, (0, 1), drive, [efforts], [motion], unknowns)
    per_joint = [getattr(truth, kind) for kind in PER_JOINT]
    theta = unknowns.point(motors_of(*per_joint, truth.delay, 0.0095, 0.0))
    found = fit(problem, FitStep.first(theta, 10))
    of_elbow = np.array([joint == 1 for _, joint in unknowns.names])
    known = uncertainty(problem, found).identified
    assert known[of_elbow].sum() >= 4
    problem.noise[1] = 0.1 * np.std(efforts.qpos[:, 1])
    shaken = uncertainty(problem, found).identified
    assert not shaken[of_elbow].any()
    assert np.array_equal(shaken[~of_elbow], known[~of_elbow])


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
    path = tmp_path / "arm.urdf"
    for word, other, name in (('mass value="1"', 'mass value="1.5"', "urdf"), ("arm2", "arm", "robot, urdf")):
        path.write_text(ARM.replace(word, other))
        refused(name, Robot.load(path))
    path.write_text(ARM)
    with pytest.raises(KeyboardInterrupt):
        resume(Robot.load(path))  # the same content under another path
    refused("merge_fixed", Robot.load(path, merge_fixed=False))
    refused("data", log=replace(log, qpos=qpos + 1e-12))
    refused("data", log=replace(log, time=time * (1 + 1e-12)))
    refused("data", log=replace(log, held=True))
    refused("compensate", compensate="gravity")
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
    if name == "panda" and kind == "setpoint":
        # With every step logged, since the noise between the rows shakes the robot too.
        whole = mujoco_log["simulate"](robot, truth, excite(robot, 10.0), params, moving=7, every=1, seed=seed)
        steps = replace(log, time=whole["time"], qpos=whole["qpos"])
        exported = error_of_the_export(found, steps, params, 1 / 2000)
        print(f"exported to MJCF, held out: {exported:.3g} rad; the fit's own: {after:.3g} rad")
        assert exported < 2 * after
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
