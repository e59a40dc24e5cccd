"""The plant of an identification: native results are NumPy's, for any robot, motors and control."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from robots import load_bundled
from tiny_urdf import LIMIT, joint, link, random_tree, robot, write

import batchpid as bp
from batchpid.sim import Robot, Runner
from batchpid.sim.identification import Log, excite, identify
from batchpid.sim.identification.logged_control import LoggedControl, LoggedDrive
from batchpid.sim.identification.plant import Plant, Segment
from batchpid.sim.identification.unknowns import ADDED, KINDS, Kind, Motors, take
from batchpid.task_space import native_rows
from tests.sim.tuning.identification.test_identify import ARM

DT, ROWS = 5e-4, 5
EFFORTS = LoggedDrive(DT, None, "none")
needs_extension = pytest.mark.skipif(native_rows.in_use() is None, reason="the extensions were not built")


def load(name, folder) -> Robot:
    """Return a bundled robot, or for a number one of ten links."""
    if isinstance(name, str):
        return load_bundled(name)
    return Robot.load(write(folder, robot(*random_tree(np.random.default_rng(name), 10))))


def motors_of(joints: int, rows: int = ROWS, **given) -> Motors:
    """Return motors of which some are ``given``, and the others are random."""
    rng, sizes = np.random.default_rng(1), {"strength": (0.9, 1.1), "delay": (0.0, 0.01), "stopping": (0.0, 0.01)}
    found = {}
    for name, kind in KINDS.items():
        low, high = sizes.get(name, (0.01, 0.3))
        shape = (rows, joints if kind.per_joint else 1)
        found[name] = np.full(shape, given[name]) if name in given else rng.uniform(low, high, shape)
    return found


def segments_of(arm: Robot, joints: tuple[int, ...], past: int, rows: int = ROWS, steps: int = 60) -> list[Segment]:
    rng, own = np.random.default_rng(0), list(joints)
    begins = arm.start[own] + rng.uniform(-0.01, 0.01, (rows, len(own)))
    waves = np.tile(0.05 * np.sin(0.1 * np.arange(past + steps))[:, None], len(own))
    return [
        Segment(
            q, 0.1 * rng.normal(size=len(q)), (0 if past else q) + waves, 1e-4 * rng.normal(size=(past + steps, len(q)))
        )
        for q in begins
    ]


def both(monkeypatch) -> Iterator[str]:
    """Yield with native code, and without."""
    for value in ("1", "0"):
        monkeypatch.setenv("BATCHPID_NATIVE", value)
        yield value


CASES = [("panda", range(7)), ("panda", (1, 3, 8)), ("panda", (3, 1)), ("jaco2", None), (0, None), (1, (2, 0))]


@needs_extension
@pytest.mark.parametrize("kind", ["setpoint", "effort"])
@pytest.mark.parametrize(("name", "joints"), CASES)
def test_native_code_gives_what_numpy_gives(name, joints, kind, tmp_path, monkeypatch):
    arm = load(name, tmp_path)
    joints = tuple(np.flatnonzero(arm.independent)) if joints is None else tuple(joints)
    params = bp.make_params(len(joints), kp=40.0, ki=5.0, kd=3.0) if kind == "setpoint" else None
    plant = Plant(arm, joints, LoggedDrive(DT, params, "gravity+coriolis", noisy=params is not None, substeps=2))
    past = 0 if params else 30
    fast, slow = (
        plant.simulate(motors_of(len(joints)), segments_of(arm, joints, past), past) for _ in both(monkeypatch)
    )
    assert np.abs(fast - fast[:, :1]).max() > 1e-3
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-9)


@needs_extension
@pytest.mark.parametrize("names", [(name,) for name in ADDED if name != "stribeck"] + [tuple(ADDED)], ids="+".join)
def test_effects_that_are_added_change_the_motion_alike_natively(names, panda, monkeypatch):
    params = bp.make_params(2, kp=40.0, ki=5.0, kd=3.0)
    plant = Plant(panda, (1, 3), LoggedDrive(DT, params, "none"))
    motors, segments = motors_of(2), segments_of(panda, (1, 3), 0)
    values = {"static": 9.0, "stribeck": 0.01, "saturation": 1e-3, "slew": 0.1}
    added = {name: np.full((ROWS, 2), values.get(name, 0.5)) for name in names}
    plain = plant.simulate(motors, segments, 0)
    fast, slow = (plant.simulate(motors | added, segments, 0) for _ in both(monkeypatch))
    assert np.abs(fast - plain).max() > 1e-6
    np.testing.assert_allclose(fast, slow, rtol=0, atol=1e-9)


EFFECTS = {"lag": 0.002, "sensor_delay": 0.0013, "backlash": 0.01, "effort_limit": 3.0, "command_delay": 0.0017}


@needs_extension
@pytest.mark.parametrize("effect", [*EFFECTS, None])
@pytest.mark.parametrize("units", ["effort", "mass_matrix", None])
@pytest.mark.parametrize("substeps", [1, 3])
def test_a_control_gives_the_same_bits_natively(effect, units, substeps, monkeypatch):
    """With each effect of the motors, and laws in every unit of gains or without law."""
    params = None if units is None else bp.make_params(2, kp=30.0, ki=5.0, kd=1.0, gain_units=units)
    drive, rng = LoggedDrive(DT, params, "none", substeps=substeps, measured_rate=True), np.random.default_rng(0)
    given = {} if effect is None else {effect: EFFECTS[effect]}
    options = bp.make_actuators(2, viscous=0.3, **given)
    full = [leaf if leaf is None or leaf.shape == (1, 1) else np.repeat(leaf, ROWS, 0) for leaf in options]
    rows = rng.normal(size=(40, 4, ROWS, 2))
    found = []
    for _ in both(monkeypatch):
        control = LoggedControl(drive, bp.Actuators(*full), *rows[0, :2], damping=np.array([0.1, 0.2]), model=matrices)
        found.append(
            [control.advance(rows[k, 2], *rows[k, :2], rows[k, 3], 1e-3 * rows[k, 3]).copy() for k in range(40)]
        )
    assert np.array_equal(*found)


def matrices(qpos):
    return np.eye(2) * (2 + np.cos(qpos))[..., None] + 0.1


@pytest.mark.parametrize("moves", [(0, 1), (1,)], ids=str)
def test_followers_move_with_their_leaders(moves, tmp_path, monkeypatch):
    mimics = ('<mimic joint="two" multiplier="-0.5" offset="0.2"/>', '<mimic joint="three" multiplier="3"/>')
    joints = [joint("one", "a", "b"), joint("two", "b", "c")]
    joints += [joint("three", "c", "d", inner=LIMIT + mimics[0]), joint("four", "c", "e", inner=LIMIT + mimics[1])]
    arm = Robot.load(write(tmp_path, robot(*map(link, "abcde"), *joints)))
    coupling, model = arm.coupling, arm.dynamics()
    rng, places = np.random.default_rng(0), list(moves)
    qpos, qvel = np.tile(arm.start, (5, 1)), np.zeros((5, arm.dof))
    qpos[:, places], qvel[:, places] = rng.uniform(-1, 1, (2, 5, len(moves)))
    whole, rates, still = coupling.positions(qpos), coupling.rates(qvel), np.zeros((5, arm.dof))
    columns = coupling.matrix[:, places]
    for _ in both(monkeypatch):
        found = Plant(arm, moves, EFFORTS).at(qpos[:, places], qvel[:, places], np.zeros((5, 1)))
        np.testing.assert_allclose(found.matrix, columns.T @ model.mass_matrix(whole) @ columns, rtol=1e-6)
        forces = model.inverse_dynamics(whole, rates, still) @ columns
        np.testing.assert_allclose(found.force, forces, rtol=1e-6, atol=1e-9)


def test_a_payload_is_a_point_mass_at_the_center_of_the_tool(panda, tmp_path):
    """As of a robot whose description has the mass."""
    heavier = panda.rigid_tree.varied({panda.rigid_tree.tool: point_mass(panda, 0.7)[None]})
    rng, joints = np.random.default_rng(0), tuple(range(7))
    qpos, qvel = np.tile(panda.start, (1, 1)), np.zeros((1, panda.dof))
    qpos[:, :7] += rng.normal(size=7)
    qvel[:, :7] = rng.normal(size=7)
    found = Plant(panda, joints, EFFORTS).at(qpos[:, :7], qvel[:, :7], np.full((1, 1), 0.7))
    matrix = bp.task_space.mass_matrix(panda.rigid_tree.held, qpos, heavier)[:, :7, :7]
    np.testing.assert_allclose(found.matrix, matrix, rtol=1e-6, atol=1e-9)
    force = bp.task_space.bias(panda.rigid_tree.held, qpos, qvel, bodies=heavier)[:, :7]
    np.testing.assert_allclose(found.force + found.payload_force, force, rtol=1e-6, atol=1e-6)


def point_mass(robot: Robot, kg: float) -> np.ndarray:
    from batchpid.task_space.spatial_inertia import SpatialInertia, spatial_matrix

    tree = robot.rigid_tree
    return spatial_matrix(SpatialInertia(kg, tree.center[tree.index(tree.tool)], np.zeros((3, 3))))


def test_a_tool_that_is_part_of_the_base_weighs_nothing(tmp_path):
    fingers = [(f"finger{n}", "0.1") for n in range(2)]
    links = "".join(
        f'<link name="{name}"><inertial><mass value="{kg}"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" '
        f'izz="1e-4"/></inertial></link><joint name="{name}" type="prismatic"><parent link="palm"/>'
        f'<child link="{name}"/><axis xyz="1 0 0"/><limit lower="0" upper="0.1" effort="9" velocity="1"/></joint>'
        for name, kg in fingers
    )
    palm = '<link name="base"/><link name="palm"/><joint name="mount" type="fixed"><parent link="base"/>'
    palm += '<child link="palm"/></joint>'
    arm = Robot.load(write(tmp_path, f'<robot name="hand">{palm}{links}</robot>'))
    assert arm.rigid_tree.tool == "palm"
    found = Plant(arm, (0, 1), EFFORTS).at(np.full((3, 2), 0.05), np.zeros((3, 2)), np.array([[0.0], [0.5], [1.0]]))
    np.testing.assert_allclose(found.matrix, np.tile(0.1 * np.eye(2), (3, 1, 1)), atol=1e-7)
    np.testing.assert_allclose(found.payload_force, 0.0, atol=1e-12)


def test_strong_friction_stops_and_limits_hold(panda):
    ideal = {"damping": 0.0, "strength": 1.0, "bias": 0.0, "delay": 0.0, "payload": 0.0, "armature": 0.0}
    motors = motors_of(2, 2, **ideal, stopping=0.0) | {"friction": np.array([[1e4, 1e4], [0.0, 0.0]])}
    plant = Plant(panda, (0, 1), LoggedDrive(DT, None, "gravity+coriolis"))
    still = np.zeros((20, 2))
    begins = (
        (np.array([0.1, 0.2]), np.array([0.5, -0.3])),
        (np.array([panda.upper[0] - 1e-4, 0.2]), np.array([2.0, 0.0])),
    )
    moved = plant.simulate(motors, [Segment(*begin, still, still) for begin in begins], 0)
    np.testing.assert_allclose(moved[0, -1], moved[0, -10], atol=1e-8)
    assert moved[1, -1, 0] == panda.upper[0]


def test_joints_that_are_fixed_keep_their_place(panda):
    tree, moves = panda.rigid_tree.held, np.arange(panda.dof) < 4
    rng = np.random.default_rng(0)
    qpos, qvel = rng.uniform(-0.03, 0.03, panda.dof) + panda.start, np.where(moves, rng.normal(size=panda.dof), 0.0)
    fixed = tree.fixed_at(qpos, moves)
    assert fixed.joint_names == tree.joint_names[:4]
    poses = (bp.task_space.link_poses(each, q) for each, q in ((tree, qpos), (fixed, qpos[moves])))
    for pose, wanted in zip(*(each.values() if isinstance(each, dict) else each for each in poses), strict=True):
        np.testing.assert_allclose(pose, wanted, atol=1e-9)
    matrix = bp.task_space.mass_matrix(tree, qpos)[:4, :4]
    np.testing.assert_allclose(bp.task_space.mass_matrix(fixed, qpos[moves]), matrix, atol=1e-9)
    force = bp.task_space.bias(tree, qpos, qvel)[:4]
    np.testing.assert_allclose(bp.task_space.bias(fixed, qpos[moves], qvel[moves]), force, atol=1e-9)


def test_rows_of_a_simulation_do_not_depend_on_their_company(tmp_path):
    arm = Robot.load(write(tmp_path, ARM))
    plant = Plant(arm, (0, 1), LoggedDrive(1 / 2000, arm.designed("effort"), "gravity"))
    rng = np.random.default_rng(0)
    motors = motors_of(2, 3) | {"payload": np.array([[0.0], [0.3], [0.3]])}
    segments = [
        Segment(q, np.zeros(2), np.tile(q + 0.2, (50, 1)), np.zeros((50, 2))) for q in rng.uniform(-1, 1, (3, 2))
    ]
    together = plant.simulate(motors, segments, 0)
    for k in range(3):
        assert np.array_equal(plant.simulate(take(motors, [k]), [segments[k]], 0)[0], together[k])


def test_an_effect_of_the_motors_is_identified_by_a_line_in_the_table(monkeypatch, tmp_path):
    """Here the lag: from a log of the Runner, and in the file that is saved."""
    monkeypatch.setitem(KINDS, "lag", Kind("lag", True, 1e-3, 0.1, 5e-3, 20.0, 5e-3))
    monkeypatch.setattr("batchpid.sim.identification.fit_search.GENERATIONS", 1)
    monkeypatch.setattr("batchpid.sim.identification.fit_search.NEIGHBOUR_EVALUATIONS", 2)
    arm, dt = Robot.load(write(tmp_path, ARM)), 1e-3
    truth, params = [0.006, 0.012], arm.designed("effort").replace(setpoint_weight=1.0)
    plain = {"armature": [0.1, 0.03], "viscous": [0.5, 0.2], "command_delay": 0.003}
    motion = excite(arm, 1.6, rate=1 / dt, lowest=0.6).position
    options = {"params": params, "compensate": "none", "timestep": dt, "workers": 0}
    with Runner(arm, 1, substeps=1, **options, actuators=bp.make_actuators(2, **plain, lag=truth)) as runner:
        begin = runner.reset(motion[:1]).qpos
        qpos = np.concatenate([begin, runner.rollout(motion[:, None]).qpos[:, 0]])[:-1]
    time = dt * np.arange(len(qpos))
    log = Log("log", (0, 1), "setpoint", time, qpos, time, motion, False)
    found = identify(arm, log, **options, payload=False, evaluations=8)
    for number, wanted in enumerate(truth):
        assert found.interval("lag", number)[0] == pytest.approx(wanted, rel=0.1)
    found.save(tmp_path / "motors.yaml")
    saved = bp.load_actuators(tmp_path / "motors.yaml", arm.joint_names)[0]
    np.testing.assert_allclose(saved.lag[0], truth, rtol=0.1)
