"""Hello, world: N scenes with a ground, a robot, and a box that falls from 0.5 m above the ground.

    python examples/hello_world.py

``build(scene, env)`` is SAPIEN code as in its tutorial. The scenes are headless: visuals and lights
are ignored.
"""

import numpy as np

from batchpid.sim import Robot, Runner

HALF = 0.5  # half the box's edge [m]


def build(scene, env):
    """Add lights and a red box, 0.1 m higher than in the env before."""
    import sapien

    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[HALF, HALF, HALF])
    builder.add_box_visual(half_size=[HALF, HALF, HALF], material=[1.0, 0.0, 0.0])
    box = builder.build(name="box")
    box.set_pose(sapien.Pose(p=[1.5, 0, HALF + 0.5 + 0.1 * env]))
    scene.set_ambient_light([0.5, 0.5, 0.5])
    scene.add_directional_light([0, 1, -1], [0.5, 0.5, 0.5])
    return box  # Runner.poses() returns the pose of the returned entity


def main(num_envs=4):
    """Drop the boxes while the robots hold their start pose."""
    robot = Robot.load("panda")
    with Runner(robot, num_envs, engine="sapien", build=build) as runner:
        print("time [s]   height of each box's lower side [m]")
        for tick in range(51):
            if tick % 5 == 0:
                heights = runner.poses()[:, 0, 2] - HALF
                print(
                    f"{tick * runner.substeps * runner.timestep:8.2f}   "
                    + "  ".join(f"{z:6.3f}" for z in heights)
                )
            obs = runner.step(robot.start)
        moved = np.abs(obs.qpos - robot.start).max()
        print(f"the robots moved by {moved:.1e} rad at most")
        runner.reset()
        print("after a reset:", np.round(runner.poses()[:, 0, 2] - HALF, 3))


if __name__ == "__main__":
    main()
