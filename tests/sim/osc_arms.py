"""An arm of six joints, and a regular pose of the panda."""

import numpy as np
from tiny_urdf import joint, link, robot, write

from batchpid.sim import Robot

START = np.array([0.0, -0.5, 0.0, -2.2, 0.0, 1.8, 0.8, 0.02, 0.02])


def six(folder, dynamics=""):
    """Return an arm of six joints: yaw, pitch, pitch, roll, pitch, roll."""
    inertial = (
        '<inertial><origin xyz="0 0 0.15"/><mass value="2"/>'
        '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.01"/></inertial>'
    )
    limit = f'<limit lower="-3" upper="3" effort="150" velocity="5"/>{dynamics}'
    parts, axes = [link("l0", inertial)], ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    for number, axis in enumerate(axes, 1):
        one = joint(f"j{number}", f"l{number - 1}", f"l{number}", inner=limit, origin="0 0 0.3")
        parts += [link(f"l{number}", inertial), one.replace("0 1 0", axis)]
    return Robot.load(write(folder, robot(*parts)))
