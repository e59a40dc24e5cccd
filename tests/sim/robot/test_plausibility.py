"""Figures that no robot has are reported with their cause, and no sound robot is."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import load_bundled
from tiny_urdf import LIMIT, joint, link, robot, write

from batchpid.sim import Robot
from batchpid.sim.randomization.distributions import elements

CODES = {"scale", "mass", "inertia"}


def inertial(mass: float, gyration: float = 0.05, at: str = "0 0 0.15") -> str:
    moment = mass * gyration**2
    entries = " ".join(
        f'{key}="{moment if key[1] == key[2] else 0}"'
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    return f'<inertial><origin xyz="{at}"/><mass value="{mass}"/><inertia {entries}/></inertial>'


def box(size: float) -> str:
    """A box of 1 x 1 x 4 in units of a tenth, at the middle of a link."""
    sides = " ".join(str(size * side) for side in (0.1, 0.1, 0.4))
    middle = f"0 0 {0.2 * size}"
    return (
        f'<collision><origin xyz="{middle}"/><geometry><box size="{sides}"/></geometry></collision>'
    )


def arm(folder, mass=3.0, gyration=0.1, size=1.0, by_shapes=False, scale=1.0, base="") -> Robot:
    """Return an arm of three links of 0.4 m, ``scale`` times as long, whose second joint bears
    gravity.
    """
    inner = (
        "" if by_shapes else inertial(mass * scale**3, gyration * scale, f"0 0 {0.2 * scale}")
    ) + box(size * scale)
    limit = LIMIT.replace('"10"', '"1e9"')
    names = ["base", "a", "b", "c"]
    joints = [
        joint(f"j{k}", *ends, inner=limit, origin=f"0 0 {0.4 * scale}")
        for k, ends in enumerate(pairwise(names))
    ]
    return Robot.load(
        write(
            folder, robot(link("base", base), *(link(name, inner) for name in names[1:]), *joints)
        ),
        self_collision="urdf",
    )


def found(described: Robot) -> dict[str, str]:
    return {each.code: str(each) for each in described.check() if each.code in CODES}


@pytest.mark.parametrize(
    ("wrong", "code", "message"),
    [
        (
            {"size": 1000.0, "by_shapes": True},
            "scale",
            r"link '.' \(424 m\): no robot.* 1.2 m long; give sizes in metres.*0.001",
        ),
        (
            {"size": 1000.0},
            "mass",
            r"link '.' \(3 kg over 424 m\): no link of such a size has such a mass; give <mass> in kg",
        ),
        ({"size": 0.001}, "scale", r"robot: no robot has such small.* 0.00042 m.*1.2 m"),
        (
            {"mass": 3000.0},
            "mass",
            r"\(3e\+03 kg over 0.424 m\): no link of such a size has such",
        ),
        ({"gyration": 100.0}, "inertia", r"\(100 m\): no link has so much inertia.*kg m\^2"),
    ],
)
def test_wrong_units_are_reported_with_figure_cause_and_remedy(wrong, code, message, tmp_path):
    findings = found(arm(tmp_path, **wrong))
    assert re.search(message, findings[code]), findings
    assert all(text.startswith("warning: ") for text in findings.values())


@given(
    scale=st.floats(0.2, 5.0),
    density=st.floats(0.03, 20.0),
    gyration=st.floats(0.01, 0.4),
    size=st.floats(0.3, 1.2),
    by_shapes=st.booleans(),
)
@settings(max_examples=15)
def test_arms_of_any_size_and_usual_density_are_sound(
    scale, density, gyration, size, by_shapes, tmp_path_factory
):
    folder = tmp_path_factory.mktemp("arm")
    described = arm(folder, 3.0 * density, gyration, size, by_shapes, scale)
    assert found(described) == {}


@pytest.mark.parametrize("name", Robot.bundled())
def test_bundled_robots_are_sound(name):
    assert found(load_bundled(name)) == {}


def test_a_stand_and_light_frames_may_have_any_figures(tmp_path):
    """A fixed base does not move, and frames of sensors are often given 1 kg m^2."""
    assert found(arm(tmp_path, base=inertial(1000.0, 50.0))) == {}
    described = arm(tmp_path)
    frame = link("camera", inertial(0.001, 30.0)) + joint("fix", "c", "camera", "fixed", "")
    described.path.write_text(described.path.read_text().replace("</robot>", f"{frame}</robot>"))
    assert found(Robot.load(described.path, self_collision="urdf")) == {}


def test_masses_are_those_of_the_simulation(tmp_path):
    """Of each link, and in the robot's repr without SAPIEN."""
    shaped = arm(tmp_path, by_shapes=True)
    masses = shaped.link_masses
    assert {name: mass.source for name, mass in masses.items()} == {
        "base": "none",
        **dict.fromkeys("abc", "shapes"),
    }
    assert masses["a"].mass == pytest.approx(4.0)
    assert elements("link_mass", shaped) == [*"abc"]
    assert masses["a"].size == pytest.approx(np.sqrt(0.18))
    assert masses["a"].gyration == pytest.approx(np.sqrt(0.17 / 12))
    assert ", 3 links with the mass of shapes, path=" in repr(shaped)
    assert ", 9 kg, path=" in repr(arm(tmp_path))
