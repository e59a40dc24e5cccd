"""A run restored from a snapshot, in a new process too, is bit-identical to the run that went on from it."""

from __future__ import annotations

import dataclasses
import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
from identical import assert_identical
from robots import RUBBING, load_bundled

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import Runner, Snapshot
from batchpid.sim.options import default_params

N = 5


def commands(robot, ticks, seed=0):
    """Setpoints that shake the robot: with the jaco2's light fingers that means contact, many at a time."""
    noise = np.random.default_rng(seed).uniform(-0.5, 0.5, (ticks, N, robot.dof))
    return np.clip(robot.settings.target + noise, robot.lower, robot.upper)


def params(robot, **options):
    options = {
        "derivative_filter_time": 4e-3,
        "anti_windup": "back_calculation",
        "setpoint_weight": 0.7,
    } | options
    return robot.params(**options)


KINDS: list = [("jaco2", "pid", 2), (RUBBING, "drive", 0)]
MORE_KINDS = [("jaco2", "drive", 0), ("jaco2", "effort", 0), (RUBBING, "pid", 0)]
KINDS += [pytest.param(*kind, marks=pytest.mark.slow) for kind in MORE_KINDS]


@pytest.mark.usefixtures("engine")
@pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning")  # light fingers under efforts, in MuJoCo
@pytest.mark.parametrize(("name", "control", "workers"), KINDS)
def test_it_restores_in_place_and_in_another_runner(name, control, workers, tmp_path):
    robot = load_bundled(name)
    table = commands(robot, 16) if control != "effort" else 5 * (commands(robot, 16) - robot.settings.target)
    chosen = params(robot) if control == "pid" else default_params(robot, control)
    with Runner(robot, N, workers=workers, control=control, params=chosen) as runner:
        runner.rollout(table[:8])
        snapshot = runner.snapshot()
        went_on = runner.rollout(table[8:])
        runner.restore(snapshot)
        assert_identical(went_on, runner.rollout(table[8:]))
    snapshot.save(tmp_path / "at8.npz")
    for carried in (Snapshot.load(tmp_path / "at8.npz"), pickle.loads(pickle.dumps(snapshot))):
        with Runner(robot, N, workers=0, control=control, params=chosen) as other:
            other.rollout(table[:3])
            other.restore(carried)
            assert_identical(went_on, other.rollout(table[8:]))
            assert other.time == pytest.approx(went_on.time[-1])


def test_it_restores_in_a_new_process(jaco2, tmp_path):
    table = commands(jaco2, 20)
    with Runner(jaco2, N, workers=0, params=params(jaco2)) as runner:
        runner.rollout(table[:10])
        runner.snapshot().save(tmp_path / "s.npz")
        went_on = runner.rollout(table[10:])
    np.save(tmp_path / "table.npy", table[10:])
    program = (
        "import sys, numpy as np; from sim import *; folder = sys.argv[1] + '/'; robot = Robot.load('jaco2')\n"
        f"with Runner(robot, {N}, params=robot.params(), workers=0) as runner:\n"
        "    runner.restore(Snapshot.load(folder + 's.npz'))\n"
        "    np.save(folder + 'qpos.npy', runner.rollout(np.load(folder + 'table.npy')).qpos)\n"
    )
    environment = {"PYTHONPATH": ":".join(filter(None, sys.path)), "PATH": ""}
    subprocess.run([sys.executable, "-W", "ignore", "-c", program, tmp_path], check=True, env=environment)
    np.testing.assert_array_equal(np.load(tmp_path / "qpos.npy"), went_on.qpos)


def test_in_free_motion_the_barrier_changes_the_last_bits_only(panda):
    middle = (panda.lower + panda.upper) / 2
    options = {"params": panda.params(), "workers": 0, "ground": False}
    results = []
    for checkpoint_steps in (None, 40):
        with Runner(panda, 2, checkpoint_steps=checkpoint_steps, **options) as runner:
            runner.reset(qpos=middle)
            results.append(runner.rollout(np.broadcast_to(middle + 0.01, (20, panda.dof))))
    np.testing.assert_allclose(results[0].qpos, results[1].qpos, rtol=0, atol=1e-7)
    assert np.abs(results[0].qpos[-1] - middle).max() > 1e-3


def test_checkpoints_are_bit_identical_for_any_number_of_workers(jaco2):
    table = commands(jaco2, 16)
    results = []
    for workers in (0, 2):
        with Runner(jaco2, N, params=params(jaco2), workers=workers, checkpoint_steps=100) as runner:
            results.append(runner.rollout(table))
    assert_identical(*results)


def test_it_holds_faults_params_and_user_content(panda):
    import sapien

    def box(scene, env):
        builder = scene.create_actor_builder()
        builder.add_box_collision(half_size=[0.05, 0.05, 0.05])
        actor = builder.build(name="box")
        actor.set_pose(sapien.Pose([0.6, 0.1 * env, 0.3 + 0.05 * env]))
        return [actor]

    table = commands(panda, 30)
    table[5, 2] = np.nan
    options = {"params": panda.params(), "workers": 0, "on_invalid_input": "contain", "build": box}
    with Runner(panda, N, **options) as runner:
        with pytest.warns(UserWarning, match="env 2"):
            runner.rollout(table[:15])
        runner.params = params(panda, kp=30.0)
        snapshot, poses = runner.snapshot(), runner.poses()
        went_on, end = runner.rollout(table[15:]), runner.poses()
    assert not went_on.ok[:, 2].any()
    assert not np.array_equal(poses, end)
    with Runner(panda, N, **options) as other:
        other.restore(snapshot)
        np.testing.assert_array_equal(other.poses(), poses)
        np.testing.assert_array_equal(other.params.kp, 30.0)
        assert not other.faults
        assert_identical(went_on, other.rollout(table[15:]))
        np.testing.assert_array_equal(other.poses(), end)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 4}, "num_envs 5, not 4"),
        ({"timestep": 1e-3}, "timestep"),
        ({"control": "drive"}, "control 'pid', not 'drive'"),
        ({"compensate": "none"}, "compensate"),
        ({"physics": "fast"}, "physics"),
        ({"ground": False}, "ground"),
        ({"robot": load_bundled("jaco2")}, "robot 'panda', not 'jaco2'"),
    ],
)
def test_a_snapshot_of_a_runner_with_other_options_is_refused(panda, options, message):
    base = {"robot": panda, "num_envs": N, "workers": 0}
    with Runner(**base) as runner:
        snapshot = runner.snapshot()
    with Runner(**(base | options)) as other:
        before = other.observe()
        with pytest.raises(InvalidArgumentError, match=message):
            other.restore(snapshot)
        assert_identical(before, other.observe())
        with pytest.raises(InvalidArgumentError, match="snapshot: must be a Snapshot"):
            other.restore(before)


def box(scene, env):
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[0.05, 0.05, 0.05])
    builder.build(name="box")


@pytest.mark.parametrize("builds", [(box, None), (None, box)])
def test_a_snapshot_of_another_build_is_refused(panda, builds):
    first, second = (Runner(panda, 2, params=panda.params(), workers=0, build=build) for build in builds)
    with first, second:
        snapshot, before = first.snapshot(), second.observe()
        with pytest.raises(InvalidArgumentError, match=r"snapshot: is of a runner with another build"):
            second.restore(snapshot)
        assert_identical(before, second.observe())


BROKEN = {
    "an older format": (lambda head, tables: head.update(format=2), "cannot be read as a snapshot: format 2, not 12"),
    "about": (lambda head, tables: head.update(about=[]), "cannot be read"),
    "steps": (lambda head, tables: head.update(steps=-1), "cannot be read"),
    "a marker": (lambda head, tables: head.update(markers={"anti_windup": "Evil"}), "cannot be read"),
    "no integral": (lambda head, tables: tables.pop("controller.integral"), "no controller.integral"),
    "no start": (lambda head, tables: tables.pop("containment.start_qvel"), "no containment.start_qvel"),
    "more": (lambda head, tables: tables.update(more=np.zeros(1)), "cannot be read"),
    "an unknown leaf": (
        lambda head, tables: tables.update({"containment.x": np.zeros(2)}),
        "an unknown containment.x",
    ),
    "text": (lambda head, tables: tables.update(engine=tables["engine"].astype("U8")), "engine of <U8"),
    "another precision": (lambda head, tables: tables.update(engine=np.float32(tables["engine"])), "engine of float32"),
    "rows of another rank": (lambda head, tables: tables.update(engine=np.zeros(2)), r"engine of float64 \(2,\)"),
    "one env": (lambda head, tables: tables.update(engine=tables["engine"][:1]), r"engine of float64 \(1, 31\)"),
    "short rows": (lambda head, tables: tables.update(engine=tables["engine"][:, :-1]), "env 0: holds other content"),
    "long rows": (
        lambda head, tables: tables.update(engine=np.pad(tables["engine"], ((0, 0), (0, 1)))),
        "env 0: holds other content",
    ),
    "no rows": (lambda head, tables: tables.pop("engine"), "cannot be read"),
    "efforts of one env": (lambda head, tables: tables.update(effort=tables["effort"][:1]), r"effort \(1, 9\)"),
    "a joint beyond": (
        lambda head, tables: tables.update({"containment.joint": np.full(2, 9)}),
        "names a joint beyond 9",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_damaged_snapshot_is_refused_before_anything_changes(panda, case, tmp_path):
    damage, message = BROKEN[case]
    with Runner(panda, 2, params=panda.params(), workers=0) as runner:
        runner.snapshot().save(tmp_path / "good.npz")
        with np.load(tmp_path / "good.npz") as file:
            tables = dict(file)
        head = json.loads(str(tables.pop("head")))
        damage(head, tables)
        np.savez(tmp_path / "bad.npz", head=np.array(json.dumps(head)), **tables)
        before = runner.step(panda.settings.target)
        with pytest.raises(InvalidArgumentError, match=message):
            runner.restore(Snapshot.load(tmp_path / "bad.npz"))
        assert_identical(before, runner.observe())
        assert runner.step(panda.settings.target).ok.all()


def test_a_file_of_the_format_before_is_read(panda, tmp_path):
    """Format 10 had one more value for each robot in SAPIEN, after positions, velocities and root."""
    with Runner(panda, 2, params=panda.params(), workers=0) as runner:
        runner.step(panda.settings.target)
        runner.snapshot().save(tmp_path / "new.npz")
        expected = runner.step(panda.settings.target)
        with np.load(tmp_path / "new.npz") as file:
            tables = dict(file)
        head = json.loads(str(tables.pop("head"))) | {"format": 10}
        tables["engine"] = np.insert(tables["engine"], 2 * panda.dof + 13, 1.0, axis=1)
        np.savez(tmp_path / "old.npz", head=np.array(json.dumps(head)), **tables)
        runner.restore(Snapshot.load(tmp_path / "old.npz"))
        assert_identical(runner.step(panda.settings.target), expected)


def test_a_file_that_is_no_snapshot_is_refused_and_not_executed(panda, tmp_path):
    class Evil:
        def __reduce__(self):
            return (tmp_path.joinpath("ran").touch, ())

    with Runner(panda, 1, params=panda.params(), workers=0) as runner:
        runner.snapshot().save(tmp_path / "good.npz")
        whole = (tmp_path / "good.npz").read_bytes()
    contents = {
        "empty": b"",
        "text": b"hello",
        "cut short": whole[: len(whole) // 2],
        "pickle": pickle.dumps(Evil()),
    }
    for content in contents.values():
        (tmp_path / "bad.npz").write_bytes(content)
        with pytest.raises(InvalidArgumentError, match="cannot be read as a snapshot"):
            Snapshot.load(tmp_path / "bad.npz")
    np.savez(tmp_path / "bad.npz", head=np.array([Evil()], dtype=object))
    with pytest.raises(InvalidArgumentError, match="cannot be read"):
        Snapshot.load(tmp_path / "bad.npz")
    np.savez(tmp_path / "bad.npz", other=np.zeros(3))
    with pytest.raises(InvalidArgumentError, match="cannot be read"):
        Snapshot.load(tmp_path / "bad.npz")
    with pytest.raises(InvalidArgumentError, match="cannot be read"):
        Snapshot.load(tmp_path / "missing.npz")
    assert not (tmp_path / "ran").exists()


def test_its_repr_is_one_line(panda):
    with Runner(panda, 2, params=panda.params(), workers=0) as runner:
        runner.step(panda.start)
        snapshot = runner.snapshot()
    assert repr(snapshot) == "Snapshot(panda, 2 envs, control 'pid', after 20 sim steps)"
    assert repr(snapshot.states) == "EnvStates(2 envs, 9 joints)"


def test_it_is_immutable_and_equals_itself_alone(panda):
    with Runner(panda, 1, params=panda.params(), workers=0) as runner:
        snapshot = runner.snapshot()
    for each in (snapshot, snapshot.states):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(each, dataclasses.fields(each)[0].name, None)
        assert len({each, dataclasses.replace(each)}) == 2


@pytest.mark.parametrize("effect", [{"command_delay": 2e-3}, {"sensor_delay": 2e-3}], ids=str)
def test_a_file_holds_the_delays_of_motors_alone_and_of_sensors_alone(effect, tmp_path):
    robot = load_bundled("panda")
    options = {"workers": 0, "actuators": bp.make_actuators(robot.dof, **effect)}
    with Runner(robot, 1, **options) as runner:
        runner.step(robot.settings.target)
        runner.snapshot().save(tmp_path / "s.npz")
        expected = runner.step(robot.settings.target)
        runner.restore(Snapshot.load(tmp_path / "s.npz"))
        assert_identical(expected, runner.step(robot.settings.target))
