"""Bundled robots: the figures of their sources, the tutorial's settings, and shapes that do not
touch each other.
"""

import importlib.resources

import numpy as np
import pytest
import yaml
from lxml import etree

import batchpid.task_space as ts
from batchpid.sim import Robot

ROBOTS = ("panda", "jaco2")

# Total mass of the sources that assets/README.md names [kg].
MASS = {"panda": 17.451901, "jaco2": 5.55724}

GAINS = {
    "panda": [(40, 5, 2)] * 7 + [(0.1, 0, 0.02)] * 2,
    "jaco2": (
        [(40, 5, 2)] * 3 + [(20, 5, 2)] + [(5, 0.8, 2)] * 2 + [(5, 0.8, 0.4)] + [(0.1, 0, 0.02)] * 6
    ),
}


def xml(name):
    return etree.fromstring(
        (importlib.resources.files("batchpid.assets") / f"{name}.urdf").read_bytes()
    )


def settings(name):
    return yaml.safe_load(
        (importlib.resources.files("batchpid.assets") / f"{name}.yaml").read_text()
    )


def passive(robot, qpos, qvel):
    """Return the passive force of a robot at one pose and rate (dof,)."""
    return ts.bias(robot.kinematic_tree(), np.array([qpos]), np.array([qvel]))[0]


@pytest.fixture(params=ROBOTS)
def name(request):
    return request.param


def test_shapes_are_primitives_and_materials_exist(name):
    root = xml(name)
    shapes = [shape for geometry in root.iter("geometry") for shape in geometry]
    assert {shape.tag for shape in shapes} <= {"box", "cylinder", "sphere"}
    sizes = [float(x) for shape in shapes for key in shape.attrib for x in shape.get(key).split()]
    assert min(sizes) > 0
    defined = {material.get("name") for material in root.findall("material")}
    assert {material.get("name") for material in root.iterfind("link/visual/material")} == defined


def test_every_link_has_a_material_a_collision_shape_and_a_possible_inertia(name):
    for link in xml(name).findall("link"):
        assert link.find("visual/material") is not None
        assert link.find("collision") is not None
        entry = {key: float(value) for key, value in link.find("inertial/inertia").attrib.items()}
        matrix = [
            [entry["ixx"], entry["ixy"], entry["ixz"]],
            [entry["ixy"], entry["iyy"], entry["iyz"]],
            [entry["ixz"], entry["iyz"], entry["izz"]],
        ]
        small, middle, large = np.linalg.eigvalsh(matrix)
        assert small > 0
        assert small + middle >= large, "no solid has these moments"


def test_the_total_mass_is_that_of_the_source_and_no_link_is_massless(name):
    masses = [float(mass.get("value")) for mass in xml(name).iter("mass")]
    assert sum(masses) == pytest.approx(MASS[name], abs=1e-6)
    assert min(masses) == pytest.approx(0.01 if name == "jaco2" else 0.015)


def test_panda_passive_force_is_that_of_the_source():
    # Expected values: SAPIEN 3.0.3 on the source description, without mimic and meshes.
    found = passive(
        Robot.load("panda"),
        [0.3, -0.4, 0.5, -1.6, 0.7, 1.8, -0.9, 0.01, 0.03],
        [0.5, -1, 1.5, 0.8, -1.2, 2, -0.7, 0.05, -0.02],
    )
    expected = [
        1.782364,
        -14.247656,
        -5.767752,
        19.389013,
        1.209106,
        2.049891,
        -0.035392,
        0.028486,
        -0.038695,
    ]
    np.testing.assert_allclose(found, expected, atol=5e-5)


def test_jaco2_passive_force_without_the_additions_is_that_of_the_source(tmp_path):
    # Expected values: SAPIEN 3.0.3 on the source description, which has neither finger 2 nor moving
    # tips.
    root = xml("jaco2")
    for element in root.findall("link") + root.findall("joint"):
        label = element.get("name")
        if label.endswith(("finger_2", "tip_2")):
            root.remove(element)
        elif element.tag == "joint" and "tip" in label:
            element.set("type", "fixed")
    (path := tmp_path / "jaco2.urdf").write_bytes(etree.tostring(root))
    found = passive(
        Robot.load(path),
        [0.3, 2.6, 0.5, 1.9, -0.7, 2.4, 0.9, 0.4, 0.8],
        [0.5, -1, 1.5, 0.8, -1.2, 2, -0.7, 0.6, -0.4],
    )
    expected = [
        0.67722,
        2.546988,
        -2.425809,
        4.644617,
        0.909402,
        0.181891,
        0.00139,
        0.007114,
        -0.004496,
    ]
    np.testing.assert_allclose(found, expected, atol=5e-5)


def test_no_links_touch_at_start_or_target_or_between(name):
    robot = Robot.load(name)
    start, target = robot.settings.start, robot.settings.target
    poses = start + np.linspace(0, 1, 21)[:, None] * (target - start)
    assert not robot.dynamics(ground=True).in_contact(poses).any()


def test_settings_are_the_tutorials_and_within_limits(name):
    data, robot = settings(name), Robot.load(name)
    rows = data["joints"].values()
    assert data["drive"] == {"stiffness": 20, "damping": 5}
    assert [(row["kp"], row["ki"], row["kd"]) for row in rows] == GAINS[name]
    for values in (robot.settings.start, robot.settings.target):
        assert (values >= robot.lower - 1e-6).all()
        assert (values <= robot.upper + 1e-6).all()
