"""User content of a scene: built in any process, separate from env to env, and reset with its
env.
"""

import threading

import numpy as np
import pytest
import trimesh
from robots import load_bundled

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Runner

ROBOT = load_bundled("panda")


def pose(*place):
    import sapien  # which the runner has imported

    return sapien.Pose(*place)


DROP = 0.5 * 9.81 * 0.2**2


def box_beside_the_robot(scene, env):
    """Add a box as SAPIEN's tutorial does, visual and lights included; each env's falls from
    higher.
    """
    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[0.5, 0.5, 0.5])
    builder.add_box_visual(half_size=[0.5, 0.5, 0.5], material=[1.0, 0.0, 0.0])
    box = builder.build(name="box")
    box.set_pose(pose([2, 0, 1.0 + 0.1 * env]))
    scene.set_ambient_light([0.5, 0.5, 0.5])
    scene.add_directional_light([0, 1, -1], [0.5, 0.5, 0.5])
    return box


def balls_on_the_arm(scene, env):
    """Add balls that touch the robot and each other, of another size in each env."""
    balls = []
    for k in range(3):
        builder = scene.create_actor_builder()
        builder.add_sphere_collision(radius=0.05 + 0.01 * (env % 3))
        builder.set_initial_pose(
            pose([0.02 if k == 0 else 0.4, 0.0, 1.25 if k == 0 else 0.1 + 0.12 * k])
        )
        balls.append(builder.build())
    return balls


def drawer_and_door(scene, env):
    """Add a drawer that slides and a door that falls through the air, visuals included; both move,
    in each env otherwise.
    """
    entities = []
    for joint, fixed in (("prismatic", True), ("revolute", False)):
        builder = scene.create_articulation_builder()
        frame = builder.create_link_builder()
        frame.add_box_collision(half_size=[0.1, 0.1, 0.1])
        leaf = builder.create_link_builder(frame)
        leaf.set_joint_properties(joint, [[-9, 9]], pose(), pose([0, 0, -0.3]))
        leaf.add_box_collision(half_size=[0.1, 0.1, 0.1])
        leaf.add_box_visual(half_size=[0.1, 0.1, 0.1], material=[1.0, 0.0, 0.0])
        builder.set_initial_pose(pose([2, 3 * fixed, 5]))
        articulation = builder.build(fix_root_link=fixed)
        articulation.set_qpos([0.1 * env])
        articulation.set_qvel([1.0])
        articulation.set_qf([0.5])
        entities += [link.entity for link in articulation.links]
    return entities


def run(build, num_envs=4, ticks=30, **options):
    options = {"engine": "sapien", "params": ROBOT.params(), "build": build, **options}
    with Runner(ROBOT, num_envs, **options) as runner:
        rollout = runner.rollout(np.broadcast_to(ROBOT.start, (ticks, ROBOT.dof)))
        return rollout, runner.poses()


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_content_falls_and_a_reset_puts_it_back(workers):
    with Runner(
        ROBOT,
        2,
        engine="sapien",
        params=ROBOT.params(),
        workers=workers,
        build=box_beside_the_robot,
    ) as runner:
        before = runner.poses()
        np.testing.assert_allclose(
            before[:, 0], [[2, 0, 1.0, 1, 0, 0, 0], [2, 0, 1.1, 1, 0, 0, 0]], atol=1e-6
        )
        for _ in range(20):
            runner.step(ROBOT.start)
        after = runner.poses()
        np.testing.assert_allclose((before - after)[:, 0, 2], DROP, rtol=1e-2)
        for _ in range(80):
            runner.step(ROBOT.start)
        np.testing.assert_allclose(runner.poses()[:, 0, 2], 0.5, atol=2e-3)
        runner.reset(mask=np.array([False, True]))
        poses = runner.poses()
        np.testing.assert_allclose(poses[0, 0, 2], 0.5, atol=2e-3)
        np.testing.assert_array_equal(poses[1], before[1])
        runner.step(ROBOT.start)
        assert runner.poses()[1, 0, 2] > 1.09  # it starts at rest


def test_articulations_are_reset_and_restored():
    options = {"engine": "sapien", "params": ROBOT.params(), "workers": 0}
    with Runner(ROBOT, 2, build=drawer_and_door, **options) as runner:

        def path():
            poses = []
            for _ in range(20):
                poses.append(runner.poses())
                runner.step(ROBOT.start)
            return np.array(poses)

        first = path()
        assert (np.abs(first[-1] - first[0]).max(2) > 0.01)[:, 1:].all()  # all but the fixed frame
        snapshot = runner.snapshot()
        later = path()
        runner.restore(snapshot)
        np.testing.assert_array_equal(path(), later)
        runner.reset()
        np.testing.assert_array_equal(path(), first)


def test_content_touches_the_robot_and_no_other_env():
    lonely, _ = run(box_beside_the_robot, num_envs=1, workers=0)
    touched, balls = run(balls_on_the_arm, num_envs=4, workers=0)
    assert np.abs(touched.qpos[:, 0] - lonely.qpos[:, 0]).max() > 1e-6
    assert balls.shape == (4, 3, 7)
    again, _ = run(balls_on_the_arm, num_envs=1, workers=0)
    np.testing.assert_array_equal(again.qpos[:, 0], touched.qpos[:, 0])


def test_a_function_that_no_worker_can_import_is_sent_to_the_workers():
    scope = {}
    exec(  # as in a script's __main__ or a notebook: no worker can import it
        "def build(scene, env):\n"
        "    import sapien\n"
        "    builder = scene.create_actor_builder()\n"
        "    builder.add_sphere_collision(radius=size)\n"
        "    builder.set_initial_pose(sapien.Pose([1, env, 2]))\n"
        "    return [builder.build()]\n"
        "size = 0.1\n",
        scope,
    )
    _, poses = run(scope["build"], num_envs=3, ticks=1, workers=2)
    np.testing.assert_array_equal(poses[:, 0, 1], [0, 1, 2])


def test_errors_of_build_name_it_and_the_env():
    def wrong(scene, env):
        if env == 2:
            raise KeyError("no such thing")

    for workers in (0, 2):
        with pytest.raises(
            InvalidArgumentError,
            match="build, env 2: raised KeyError: 'no such thing'",
        ):
            run(wrong, workers=workers)
    with pytest.raises(InvalidArgumentError, match="other than entities"):
        run(lambda scene, env: [3], workers=0)
    with pytest.raises(InvalidArgumentError, match="must be a function"):
        run("build", workers=0)
    lock = threading.Lock()
    with pytest.raises(InvalidArgumentError, match="cannot be sent to a worker"):
        run(lambda scene, env: lock, workers=1)
    with pytest.raises(InvalidArgumentError, match="was not given"):
        run(None, workers=0)
    with pytest.raises(InvalidArgumentError, match="more entities for one env"):
        run(lambda scene, env: box_beside_the_robot(scene, env) if env else None, workers=0)


def test_a_convex_mesh_of_negative_scale_is_refused(tmp_path):
    """Two of them would end the process once they touch."""
    file = str(tmp_path / "box.stl")
    trimesh.creation.box((1, 1, 1)).export(file)

    def mirrored(scene, env):
        builder = scene.create_articulation_builder()
        builder.create_link_builder().add_convex_collision_from_file(file, scale=(-1, 1, 1))
        builder.build()

    with pytest.raises(InvalidArgumentError, match=r"build, env 0: gave .* of negative scale"):
        run(mirrored, num_envs=1, ticks=1, workers=0)
