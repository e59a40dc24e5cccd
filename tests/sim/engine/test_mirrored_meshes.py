"""Meshes of negative scale are simulated as the mirror images that they are; PhysX crashes where
two of them touch.
"""

import numpy as np
import pytest
from tiny_urdf import joint, link, robot, write

from batchpid.sim import Robot

FACES = (0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)
CORNERS = np.array([[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0], [0.1, 0.1, 0.4]])
MESH = (
    '<collision><origin xyz="0.1 0 0"/><geometry><mesh filename="{}" scale="{} {}'
    ' {}"/></geometry></collision>'
)


def arms(mesh, scale):
    parts = [link(name, MESH.format(mesh, *scale)) for name in ("left", "right")]
    joints = [
        joint("a", "base", "left", origin="0 0 1"),
        joint("b", "base", "right", origin="0 0.05 1"),
    ]
    return robot(link("base"), *parts, *joints)


@pytest.mark.parametrize("signs", [(1, -1, 1), (-1, -1, 1), (-1, -1, -1)])
def test_a_negative_scale_is_the_mirrored_mesh(signs, tmp_path):
    for name, corners in (("tip.obj", CORNERS), ("mirrored.obj", CORNERS * signs)):
        lines = [
            *("v {} {} {}".format(*corner) for corner in corners),
            *("f {} {} {}".format(*np.add(f, 1)) for f in FACES),
        ]
        (tmp_path / name).write_text("\n".join(lines))
    texts = {
        "a.urdf": arms("mirrored.obj", (2, 2, 2)),
        "b.urdf": arms("tip.obj", 2 * np.array(signs)),
    }
    paths = [write(tmp_path, text, name) for name, text in texts.items()]
    mirrored, scaled = (
        Robot.load(path, self_collision="urdf").dynamics(ground=False) for path in paths
    )
    poses = np.array([[0.0, 0.0], [0.3, -0.2], [0.0, np.pi]])
    np.testing.assert_allclose(scaled.mass_matrix(poses), mirrored.mass_matrix(poses), rtol=1e-5)
    assert scaled.in_contact(poses).tolist() == mirrored.in_contact(poses).tolist()
    assert scaled.in_contact(poses)[0]
