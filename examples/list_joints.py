"""List all joints of a robot, then the moving ones in the order of every array.

python examples/list_joints.py jaco2
python examples/list_joints.py path/to/any.urdf
"""

import numpy as np
import tyro

from batchpid.sim import Robot, Runner


def main(robot: tyro.conf.Positional[str] = "panda", stiffness: float = 0.0) -> None:
    """Print the properties of every joint that SAPIEN's tutorial prints.

    Args:
        robot: Bundled robot (panda or jaco2), or path of a URDF.
        stiffness: Stiffness of the internal drive [N m/rad or N/m].
    """
    loaded = Robot.load(robot)
    for joint in loaded.tables.joints:
        drive = stiffness if joint.moves else 0.0
        print(
            f"name: {joint.name}  type: {joint.type}  damping: {joint.damping:g}  stiffness:"
            f" {drive:g}  friction: {joint.friction:g}  limits: [{joint.lower:g}, {joint.upper:g}]"
            f" {joint.unit}  effort: {joint.effort_limit:g}  child link: {joint.child_link}  parent"
            f" link: {joint.parent_link}"
        )
    print("active joints:", ", ".join(loaded.joint_names))
    with Runner(loaded, 1, workers=0, control="effort") as runner:
        print("qpos:", np.round(runner.observe().qpos[0], 4))


if __name__ == "__main__":
    tyro.cli(main)
