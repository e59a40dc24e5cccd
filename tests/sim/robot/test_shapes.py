"""A robot's surfaces: closed, facing out, of the right size and colour, with the collision shapes as fallback."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim import Robot
from sim.robot.shapes import FEWEST, MOST, box, cylinder, segments_of, sphere, surfaces

LINK = (
    '<link name="{name}"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    "{shapes}</link>"
)
JOINT = (
    '<joint name="j" type="revolute"><parent link="a"/><child link="b"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)
BOX = (
    '<{kind}><origin xyz="0 0 {z}" rpy="0 1.5707963267948966 0"/>'
    '<geometry><box size="0.1 0.2 0.4"/></geometry>{extra}</{kind}>'
)


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def load(folder, a="", b=""):
    path = folder / "two.urdf"
    links = LINK.format(name="a", shapes=a) + LINK.format(name="b", shapes=b)
    path.write_text(
        f'<robot name="two"><material name="red"><color rgba="1 0 0 0.5"/></material>{links}{JOINT}</robot>'
    )
    return Robot.load(path)


@pytest.mark.parametrize(
    ("mesh", "expected", "share"),
    [
        (box(np.array([0.1, 0.2, 0.4])), 0.1 * 0.2 * 0.4, 1e-12),
        (cylinder(0.2, 0.5), np.pi * 0.2**2 * 0.5, 0.02),
        (sphere(0.3), 4 / 3 * np.pi * 0.3**3, 0.04),
    ],
)
def test_primitives_are_closed_and_face_out(mesh, expected, share):
    vertices, faces = mesh
    assert volume(vertices, faces) == pytest.approx(expected, rel=share)  # positive: facing out
    points, index = np.unique(vertices.round(9), axis=0, return_inverse=True)
    corners = index.reshape(-1)[faces]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    assert (edges[:, 0] != edges[:, 1]).all()
    forth, back = set(map(tuple, edges.tolist())), set(map(tuple, edges[:, ::-1].tolist()))
    assert len(forth) == len(edges)  # every edge once in each direction: closed, and wound alike
    assert forth == back
    assert len(points) > 7


@given(radius=st.floats(1e-3, 10), deviation=st.floats(1e-4, 1e-2))
def test_chords_stay_as_near_to_the_arc_as_asked(radius, deviation):
    segments = segments_of(radius, deviation)
    if FEWEST < segments < MOST:
        assert radius * (1 - np.cos(np.pi / segments)) <= deviation * (1 + 1e-9)
        assert radius * (1 - np.cos(np.pi / (segments - 1))) > deviation
    assert FEWEST <= segments <= MOST
    assert len(sphere(radius, deviation)[0]) >= 4 * FEWEST


@pytest.mark.parametrize("name", Robot.bundled())
def test_every_link_of_a_bundled_robot_is_drawn(name):
    robot = Robot.load(name)
    drawn = surfaces(robot)
    assert {surface.link for surface in drawn} == {link.name for link in robot.links}
    for surface in drawn:
        assert surface.faces.max() < len(surface.vertices)
        assert np.abs(surface.vertices).max() < 1
        assert len(surface.rgba) == 4


def test_origin_colour_and_merging(tmp_path):
    visual = BOX.format(kind="visual", z=0.5, extra='<material name="red"/>')
    plain = BOX.format(kind="visual", z=0.0, extra='<material name="x"><color rgba="0 1 0 1"/></material>')
    red, green, *rest = surfaces(load(tmp_path, a=visual + plain + visual))
    assert not rest
    assert red.rgba == (1, 0, 0, 0.5)
    assert green.rgba == (0, 1, 0, 1)
    assert len(red.vertices) == 2 * len(green.vertices) == 48
    assert volume(red.vertices, red.faces) == pytest.approx(2 * 0.008)
    np.testing.assert_allclose(red.vertices.max(0), [0.2, 0.1, 0.55], atol=1e-12)  # turned about y: x is z


def test_collision_shapes_stand_in_for_missing_visuals(tmp_path):
    collision = BOX.format(kind="collision", z=0.0, extra="")
    lost = '<visual><geometry><mesh filename="lost.stl"/></geometry></visual>'
    drawn = surfaces(load(tmp_path, a=lost + collision, b=collision))
    assert [surface.link for surface in drawn] == ["a", "b"]
    assert surfaces(load(tmp_path)) == []


def test_a_mesh_file_is_read_and_scaled(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.stl")
    visual = '<visual><geometry><mesh filename="cube.stl" scale="0.1 0.2 0.3"/></geometry></visual>'
    (cube,) = surfaces(load(tmp_path, b=visual))
    assert cube.link == "b"
    assert volume(cube.vertices, cube.faces) == pytest.approx(0.006)
