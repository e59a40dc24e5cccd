"""Motors from logs of an arm whose motors are known."""

from dataclasses import replace

import numpy as np
import pytest
from arms import DT, STEPS, TRUTH, URDF, effort_run, gains, heavier, load, log_of, motion, run

import batchpid as bp
from batchpid.sim import Robot
from batchpid.sim.identification import Log, draw_motors, identify

KINDS = dict(armature="armature", damping="viscous", friction="coulomb", strength="strength")
NOISE = 2e-5


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return load(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def log(robot):
    """Log of setpoints."""
    return log_of(robot, run(robot, motion()), NOISE)


@pytest.fixture(scope="module")
def effort_log(robot):
    return log_of(robot, effort_run(robot), NOISE)


@pytest.fixture(scope="module")
def found(robot, log):
    return identify(robot, [log], payload=False)


def rows_of(found, truth=TRUTH):
    """Return estimate, ends of the interval and truth of the unknowns of :data:`KINDS` and of the
    delay, by kind and joint.
    """
    places = {(kind, joint): truth[KINDS[kind]][joint] for kind in KINDS for joint in (0, 1)}
    places["delay", None] = truth["command_delay"]
    return {place: (*found.interval(*place), true) for place, true in places.items()}


def outside(found, truth=TRUTH):
    """Return the unknowns whose interval does not hold the truth."""
    rows = rows_of(found, truth).items()
    return [place for place, (_, low, high, true) in rows if not low <= true <= high]


def assert_right(found, truth=TRUTH):
    """Assert that the values are near the truth, and within their intervals with few exceptions."""
    for place, (value, _, _, true) in rows_of(found, truth).items():
        assert value == pytest.approx(true, rel=0.09 if place[0] == "delay" else 0.02), place
    assert len(outside(found, truth)) <= 2


def test_motors_are_found_from_setpoints(found):
    assert_right(found)
    assert found.explains
    assert found.fit.converged
    assert found.interval("setpoint_delay") is None
    assert "not needed by these logs: setpoint_delay, setpoint_lag" in found.report()


@pytest.mark.parametrize("name", ["log", "effort_log"])
def test_an_interpolated_log_tells_what_its_delays_contain(robot, request, name):
    """The robot held the commands of each row, 5 ms long."""
    log = replace(request.getfixturevalue(name), held=False)
    found = identify(robot, [log], payload=False)
    assert not outside(found)
    assert ("delay is 0.002 s shorter" in found.report()) == (log.kind == "effort")


def test_the_number_of_workers_does_not_change_the_result(robot, effort_log):
    short = effort_log.part(slice(0, 200), slice(0, 200))
    options = {"payload": False, "evaluations": 2}
    both = [identify(robot, [short], workers=workers, **options) for workers in (0, 2)]
    np.testing.assert_array_equal(both[0].values, both[1].values)


def test_a_compensation_through_the_motors_is_part_of_the_model(tmp_path):
    """The description's friction is compensated, too; estimates include it."""
    text = URDF.replace("</joint>", '<dynamics damping="0.1" friction="0.3"/></joint>')
    robot = load(tmp_path, text)
    rollout = run(robot, motion(), compensate="gravity+coriolis+friction")
    found = identify(robot, [log_of(robot, rollout, NOISE)], payload=False)
    assert "compensates gravity+coriolis+friction" in found.report()
    assert "through its motors" in found.report()
    assert_right(found, TRUTH | {"viscous": [0.4, 0.3], "coulomb": [0.7, 0.5]})


@pytest.mark.slow
def test_a_payload_is_found_where_it_is(robot, tmp_path):
    """At the link that is fixed behind the last moving one."""
    link = """<link name="flange"><inertial><mass value="MASS"/>
    <inertia ixx="1e-9" iyy="1e-9" izz="1e-9" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    joint = """<joint name="f" type="fixed"><parent link="fore"/><child link="flange"/>
    <origin xyz="0 0 0.25"/></joint>"""
    text = URDF.replace("</robot>", f"{link}{joint}</robot>")
    loaded = load(tmp_path, text.replace("MASS", "0.5"))
    log = log_of(loaded, effort_run(loaded), NOISE)
    robot = load(tmp_path, text.replace("MASS", "0.1"))
    found = identify(robot, [log])
    assert found.interval("payload")[0] == pytest.approx(0.4, rel=0.03)
    assert_right(found)


@pytest.mark.slow
def test_delay_and_lag_of_the_sender_are_no_motors(robot):
    """Of setpoints that act late, or through a first-order filter, and are logged before."""
    setpoints = motion()
    late = np.vstack([setpoints[:1]] * 4 + [setpoints[:-4]])
    lagged = [setpoints[0]]
    for row in setpoints[1:]:
        lagged.append(lagged[-1] + STEPS * DT / (STEPS * DT + 0.03) * (row - lagged[-1]))
    cases = ("setpoint_delay", late, 0.02), ("setpoint_lag", np.array(lagged), 0.03)
    for kind, acting, true in cases:
        log = replace(log_of(robot, run(robot, acting), NOISE), command=setpoints)
        found = identify(robot, [log], payload=False)
        assert found.interval(kind)[0] == pytest.approx(true, rel=0.1)
        assert not {("damping", 0), ("damping", 1)}.intersection(outside(found))


def test_friction_and_damping_may_be_less_than_the_description_says(tmp_path, effort_log):
    text = URDF.replace("</joint>", '<dynamics damping="0.45" friction="0.5"/></joint>')
    robot = load(tmp_path, text)
    found = identify(robot, [effort_log], payload=False)
    assert_right(found)
    assert found.held_out_error[1] < 0.05 * found.held_out_error[0]
    found.save(tmp_path / "motors.yaml")
    motors = Robot.load(tmp_path / "arm.urdf", actuators=tmp_path / "motors.yaml").actuators
    np.testing.assert_allclose(motors.coulomb[0] + 0.5, TRUTH["coulomb"], rtol=0.02)
    np.testing.assert_allclose(motors.viscous[0] + 0.45, TRUTH["viscous"], rtol=0.02)
    with pytest.raises(bp.InvalidArgumentError, match=r"coulomb.*less than none"):
        Robot.load(tmp_path / "arm.urdf", actuators=bp.make_actuators(2, coulomb=-0.6))


def test_what_a_log_cannot_tell_reaches_the_symmetric_truth(tmp_path):
    """Masses, armature, damping, friction and strengths times one factor give the same motion, and
    so do kd and damping.
    """
    factor = 1.25
    robot = load(tmp_path)
    log = log_of(robot, effort_run(robot), NOISE)
    found = identify(robot, [log], payload=False, extras=["mass"])
    strength = found.estimates["shoulder"]["strength"]
    assert not strength.is_shown
    assert "elbow: armature" in strength.remark
    assert "strength not shown by these logs (cannot be told from" in found.report()
    for kind, field in KINDS.items():
        for joint, true in enumerate(TRUTH[field]):
            if row := found.interval(kind, joint):
                assert row[1] <= true <= row[2] / factor
                assert row[2] - row[1] >= 0.01 * row[0]


@pytest.mark.slow
def test_further_unknowns_are_found_on_request(robot):
    setpoints = motion()
    more = {"load_friction": [0.1, 0.08], "position_offset": [0.03, -0.02]}
    guard = robot.guard(rate=np.array([2.0, 1.5]))
    rollout = run(robot, setpoints, guard=guard, actuators=more)
    begin, qpos = rollout.time - rollout.tick, rollout.qpos[:, 0] + more["position_offset"]
    log = Log("log", (0, 1), "setpoint", rollout.time, qpos, begin, setpoints, True, DT, "none")
    extras = ["slew", "load_friction", "offset"]
    found = identify(robot, [log], gains(), payload=False, extras=extras)
    truth = {"slew": [2.0, 1.5], "strength": TRUTH["strength"], "offset": more["position_offset"]}
    for kind, true in (truth | {"load_friction": more["load_friction"]}).items():
        values = [found.interval(kind, joint)[0] for joint in (0, 1)]
        assert values == pytest.approx(true, rel=0.1), kind


@pytest.mark.slow
def test_an_effect_that_lowers_the_held_out_error_is_added(robot, tmp_path):
    heavy = load(tmp_path, heavier(1.4))
    log = log_of(robot, run(heavy, motion()), NOISE)
    better = identify(robot, [log], payload=False)
    assert better.fit.effects["mass"] < 0.5
    assert "with mass, which lowers the held-out error by" in better.report()
    pairs = zip(better.unknowns.entries, better.values, strict=True)
    factors = {entry.place: value for entry, value in pairs if entry.kind == "mass"}
    # All masses and strengths have one scale.
    assert factors["fore"] / factors["upper"] == pytest.approx(1.4, rel=0.05)
    assert better.estimates["robot"]["delay"].is_shown


MISREAD = {
    "sign": ("effort_log", "command", lambda table: table * [1.0, -1.0]),
    "unit of efforts": ("effort_log", "command", lambda table: 1e3 * table),
    "order": ("log", "qpos", lambda table: table[:, ::-1]),
    "unit of setpoints": ("log", "command", np.degrees),
}


@pytest.mark.parametrize("fault", MISREAD)
def test_a_log_with_wrong_columns_is_not_explained(robot, request, fault):
    name, field, change = MISREAD[fault]
    log = request.getfixturevalue(name)
    wrong = replace(log, **{field: change(getattr(log, field))})
    found = identify(robot, [wrong], payload=False)
    assert not found.explains
    assert "check signs, units and order" in found.report()


def test_setpoints_that_were_logged_late_are_refused(robot, log):
    late = replace(log, command_time=log.command_time + 0.03)
    with pytest.raises(bp.InvalidArgumentError, match=r"were logged about 3[05] ms late"):
        identify(robot, [late], payload=False)


def test_joints_that_did_not_move_are_left_out(robot, log):
    still = log.qpos * [1.0, 0.0]
    jammed = replace(log, qpos=still, command=log.command * [1, 0])
    found = identify(robot, [jammed], payload=False)
    assert "'elbow' did not move" in found.report()
    assert found.joint_names == ["shoulder"]
    assert found.still == ("elbow",)
    with pytest.raises(bp.InvalidArgumentError, match="show no motion of any joint"):
        identify(robot, [replace(log, qpos=0 * still, command=0 * log.command)])


def test_the_saved_file_is_what_was_found_and_holds_the_region(robot, log, found, tmp_path):
    found.save(tmp_path / "motors.yaml")
    motors = bp.load_actuators(tmp_path / "motors.yaml", robot.joint_names)[0]
    for kind, field in KINDS.items():
        assert getattr(motors, field)[0].tolist() == [
            found.interval(kind, joint)[0] for joint in (0, 1)
        ]
    # The printed error is what a Runner makes with the saved file, from the logged state.
    fields = {name: getattr(motors, name)[0] for name in (*TRUTH, "bias")}
    errors = run(robot, motion(), actuators=fields).qpos[:, 0] - log.qpos
    judged = log.time > log.time[0] + 0.75 * log.seconds
    assert np.sqrt((errors[judged] ** 2).mean()) == pytest.approx(found.held_out_error[1], rel=0.1)
    drawn = draw_motors(tmp_path / "motors.yaml", robot, 200)
    spread = drawn.strength.std(0)
    half = [found.interval("strength", joint) for joint in (0, 1)]
    np.testing.assert_allclose(spread, [0.25 * (high - low) for _, low, high in half], rtol=0.2)
    assert (drawn.coulomb >= 0).all()
    bp.save_actuators(tmp_path / "plain.yaml", motors, robot.joint_names)
    with pytest.raises(bp.InvalidArgumentError, match="confidence_region"):
        draw_motors(tmp_path / "plain.yaml", robot, 2)


def test_the_report_has_all_values_and_errors(found):
    assert "as described" in found.report()
    document = found.document()
    assert document["estimates"]["elbow"]["strength"]["value"] == found.interval("strength", 1)[0]
    assert found.interval("strength", 1) == found.interval("strength", "elbow")
    for place in (("strength", 5), ("delay", 0), ("mass", "fore"), ("speed", 0)):
        with pytest.raises(bp.InvalidArgumentError):
            found.interval(*place)


@pytest.mark.slow
def test_held_out_logs_are_not_fitted(robot, log):
    other = replace(log, held_out=True, command=log.command + 0.3)
    short = replace(log, held_out=False)
    found = identify(robot, [short, other], payload=False, evaluations=8)
    assert found.held_out_error[1] > 0.05
    assert found.interval("strength", 0)[0] == pytest.approx(0.9, rel=0.01)


WRONG = {
    "compensate": (["log"], {"compensate": "all"}),
    "timestep": (["log"], {"timestep": 0.0}),
    "extras": (["log"], {"extras": ["speed"]}),
    "evaluations": (["log"], {"evaluations": 0}),
    "hold 3 joints": (["log"], {"params": bp.make_params(3, 1.0)}),
    "is of setpoints": (["effort_log"], {"extras": ["slew"]}),
    "give no params": (["effort_log"], {"params": gains()}),
    "fit them one by one": (["effort_log", "log"], {}),
    "are missing": ([], {}),
}


@pytest.mark.parametrize("problem", WRONG)
def test_options_that_contradict_the_logs_are_refused(robot, request, problem):
    names, options = WRONG[problem]
    with pytest.raises(bp.InvalidArgumentError, match=problem):
        identify(robot, [request.getfixturevalue(name) for name in names], **options)


@pytest.mark.slow
def test_intervals_hold_the_truth(robot):
    """Of at least 90 % of 108 unknowns, as 95 % intervals do."""
    count = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        truth = {}
        for name, value in TRUTH.items():
            truth[name] = (np.array(value) * rng.uniform(0.6, 1.4, np.shape(value))).tolist()
        log = log_of(robot, run(robot, motion(seed=seed), actuators=truth), 1e-4)
        count += len(outside(identify(robot, [log], payload=False), truth))
    assert count <= 0.1 * 9 * 12
