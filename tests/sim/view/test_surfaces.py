"""Surfaces of a robot: closed, facing out, of the right size and colour, with the collision shapes
as fallback.
"""

import pickle
import re

import numpy as np
import pytest
import trimesh
from robots import load_bundled
from tiny_urdf import INERTIAL, joint, link, robot, write

from batchpid.errors import InvalidArgumentError
from batchpid.sim import Robot
from batchpid.sim.view.scene import RobotScene, surfaces

RED = '<material name="red"><color rgba="1 0 0 0.5"/></material>'
BOX = '<box size="0.1 0.2 0.4"/>'


def visual(geometry, z=0.0, material="", kind="visual"):
    """A shape turned by a quarter about y, so that its z is the link's x."""
    origin = f'<origin xyz="0 0 {z}" rpy="0 1.5707963267948966 0"/>'
    return f"<{kind}>{origin}<geometry>{geometry}</geometry>{material}</{kind}>"


def load(folder, a="", b=""):
    return Robot.load(
        write(
            folder,
            robot(RED, link("a", INERTIAL + a), link("b", INERTIAL + b), joint("j", "a", "b")),
        )
    )


def volume(vertices, faces):
    """Volume within closed triangles, positive if they face out."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


@pytest.mark.parametrize(
    ("geometry", "size", "expected", "share"),
    [
        (BOX, (0.4, 0.2, 0.1), 0.1 * 0.2 * 0.4, 1e-12),
        ('<cylinder radius="0.2" length="0.5"/>', (0.5, 0.4, 0.4), np.pi * 0.2**2 * 0.5, 0.02),
        ('<sphere radius="0.3"/>', (0.6, 0.6, 0.6), 4 / 3 * np.pi * 0.3**3, 0.04),
        ('<sphere radius="1e-5"/>', (2e-5, 2e-5, 2e-5), 4 / 3 * np.pi * 1e-15, 0.5),
        (
            '<capsule radius="0.1" length="0.3"/>',
            (0.5, 0.2, 0.2),
            np.pi * 0.1**2 * (0.3 + 4 / 3 * 0.1),
            0.06,
        ),
    ],
)
def test_primitives_face_out_and_have_their_size(geometry, size, expected, share, tmp_path):
    ((surface,), _) = surfaces(load(tmp_path, a=visual(geometry)))
    vertices, faces = surface.vertices, surface.faces
    assert volume(vertices, faces) == pytest.approx(expected, rel=share)
    np.testing.assert_allclose(np.ptp(vertices, axis=0), size, atol=2 * 2e-3)


@pytest.mark.parametrize(
    ("geometry", "angle"), [(BOX, 1), ('<cylinder radius="0.2" length="0.5"/>', 45)]
)
def test_no_vertex_is_shared_across_a_sharp_edge(geometry, angle, tmp_path):
    ((surface,), _) = surfaces(load(tmp_path, a=visual(geometry)))
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for vertex in range(len(surface.vertices)):
        around = normals[(surface.faces == vertex).any(1)]
        assert (around @ around.T > np.cos(np.radians(angle))).all()


@pytest.mark.parametrize("name", Robot.bundled())
def test_every_link_of_a_bundled_robot_is_drawn(name):
    bundled = load_bundled(name)
    drawn, findings = surfaces(bundled)
    assert findings == []
    assert {surface.link for surface in drawn} == set(bundled.tables.links)
    for surface in drawn:
        assert surface.faces.max() < len(surface.vertices)
        assert np.abs(surface.vertices).max() < 1
        assert len(surface.rgba) == 4


def test_shapes_of_one_colour_are_joined_at_their_origins(tmp_path):
    green = '<material name="x"><color rgba="0 1 0 1"/></material>'
    red = visual(BOX, 0.5, '<material name="red"/>')
    (first, second), _ = surfaces(load(tmp_path, a=red + visual(BOX, 0.0, green) + red))
    assert first.rgba == (1, 0, 0, 0.5)
    assert second.rgba == (0, 1, 0, 1)
    assert len(first.vertices) == 2 * len(second.vertices)
    assert volume(first.vertices, first.faces) == pytest.approx(2 * 0.008)
    np.testing.assert_allclose(first.vertices.max(0), [0.2, 0.1, 0.55], atol=1e-12)


def test_a_robot_without_shapes_is_refused_with_a_remedy(tmp_path):
    with pytest.raises(
        InvalidArgumentError, match="no shape that can be drawn; give its links visuals"
    ):
        RobotScene(load(tmp_path), 1, True, 24)


@pytest.mark.parametrize("mirror", [1, -1])
def test_a_mesh_file_is_read_and_scaled(mirror, tmp_path):
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.stl")
    (cube,), _ = surfaces(
        load(tmp_path, b=visual(f'<mesh filename="cube.stl" scale="0.1 {0.2 * mirror} 0.3"/>'))
    )
    assert cube.link == "b"
    assert volume(cube.vertices, cube.faces) == pytest.approx(0.006)


@pytest.mark.filterwarnings(
    "ignore:Setting the shape on a NumPy array:DeprecationWarning"
)  # pycollada, NumPy 2.5
@pytest.mark.parametrize(
    ("unit", "factor"), [("", 1.0), ('<unit name="millimeter" meter="0.001"/>', 1e-3)]
)
def test_a_collada_file_is_read_in_its_unit(unit, factor, tmp_path):
    text = trimesh.creation.box((1, 2, 3)).export(file_type="dae").decode()
    (tmp_path / "box.dae").write_text(text.replace("<up_axis>", f"{unit}<up_axis>"))
    (drawn,), findings = surfaces(load(tmp_path, b=visual('<mesh filename="box.dae"/>')))
    assert findings == []
    np.testing.assert_allclose(
        np.ptp(drawn.vertices, axis=0), np.array([3, 2, 1]) * factor, rtol=1e-6
    )


def test_meshes_that_cannot_be_read_are_reported_with_link_file_and_remedy(tmp_path):
    (tmp_path / "empty.stl").write_text("")
    (tmp_path / "box.dae").write_text("<COLLADA/>")
    for name, reason, remedy in (
        ("lost.stl", r"\('lost.stl' not found\)", "package_dirs"),
        ("empty.stl", r"\(no triangles\)", "repair the file"),
        ("box.dae", r"cannot be drawn \(", "repair the file"),
    ):
        for shape in ("", visual(BOX, kind="collision")):
            seen = visual(f'<mesh filename="{name}"/>') + shape
            _, (finding,) = surfaces(load(tmp_path, b=seen))
            assert (finding.code, finding.link) == ("missing-mesh", "b")
            assert re.search(
                f"{reason}.*: collision shapes are drawn.*; .*{remedy}", str(finding)
            ), str(finding)


def test_visuals_are_looked_up_in_package_dirs(tmp_path):
    (tmp_path / "elsewhere" / "pack").mkdir(parents=True)
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "elsewhere" / "pack" / "cube.stl")
    seen = link("b", INERTIAL + visual('<mesh filename="package://pack/cube.stl"/>'))
    path = write(tmp_path, robot(link("a"), seen, joint("j", "a", "b")))
    _, (lost,) = surfaces(Robot.load(path))
    assert lost.link == "b"
    (drawn,), _ = surfaces(Robot.load(path, package_dirs=[tmp_path / "elsewhere"]))
    assert drawn.link == "b"


def test_a_malformed_visual_is_reported_and_drawn_as_the_collision_shape(tmp_path):
    shape = visual(BOX, kind="collision")
    (drawn,), findings = surfaces(load(tmp_path, a=visual('<sphere radius="big"/>') + shape))
    assert np.ptp(drawn.vertices, axis=0) == pytest.approx((0.4, 0.2, 0.1))
    assert "link 'a' ('<visual>'): cannot be drawn (<sphere radius='big'>" in str(findings[0])


def test_what_was_repaired_is_drawn(tmp_path):
    """Loose links and copies are left out, empty attributes are defaults, an unreadable mesh is the
    collision shape.
    """
    (tmp_path / "pointer.stl").write_text("version https://git-lfs.github.com/spec/v1")
    seen = visual('<mesh filename="pointer.stl"/>') + visual(BOX, kind="collision")
    parts = (
        link("a"),
        link(" b ", INERTIAL + seen),
        link("b", visual(BOX)),
        link("loose", visual(BOX)),
    )
    text = robot(*parts, joint("j", "a", "b")).replace('xyz="0 0 0.0"', 'xyz=""')
    path = write(tmp_path, text)
    loaded = Robot.load(path)
    path.unlink()  # a file is read once
    (surface,), _ = surfaces(pickle.loads(pickle.dumps(loaded)))
    assert surface.link == "b"
    np.testing.assert_allclose(np.ptp(surface.vertices, axis=0), (0.4, 0.2, 0.1), atol=1e-9)
