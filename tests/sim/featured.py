"""Arms of nine joints with a feature each: mimic and continuous joints, massless links, armature, a
floating base.
"""

import functools
import tempfile
from pathlib import Path

import numpy as np
from tiny_urdf import write

import batchpid as bp
from batchpid.sim import Robot

AXES = ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "0 0 1", "1 0 0", "0 1 0", "0 0 1", "0 1 0")
WIDE = '<limit lower="-9" upper="9" effort="80" velocity="9"/>'
TURNED = 6.1
"""Start position of continuous joints, from which a move of 0.3 rad passes 2 pi, where SAPIEN's
positions wrap.
"""

FEATURES = {
    "mimic": {"mimics": {3: (1, -0.5, 0.1)}},
    "chain of mimics": {"mimics": {3: (1, 2.0, 0.0), 5: (3, -0.25, 0.2)}},
    "sliding mimic": {"types": {3: "prismatic"}, "mimics": {3: (1, 0.2, -0.05)}},
    "continuous": {"types": {0: "continuous", 4: "continuous"}},
    "continuous mimic": {"types": {3: "continuous"}, "mimics": {3: (1, -1.5, 0.0)}},
    "mimic of a continuous joint": {"types": {1: "continuous"}, "mimics": {3: (1, 0.25, -1.3)}},
    "sliding mimic of a continuous joint": {
        "types": {1: "continuous", 3: "prismatic"},
        "mimics": {3: (1, 0.02, -0.1)},
    },
    "whole turns of a continuous joint": {
        "types": {1: "continuous"},
        "mimics": {3: (1, -1.0, 6.3)},
    },
    "massless links": {"massless": (2, 5)},
    "armature": {"armature": 0.02},
    "floating base": {"fixed_base": False},
}
"""Types of joints other than revolute, mimic joints (leader, multiplier, offset), links without
mass, ...
"""


def joints_of(feature):
    types, mimics = (FEATURES[feature].get(name, {}) for name in ("types", "mimics"))
    return {*types, *mimics, *(leader for leader, *_ in mimics.values())}


def inertial(kg, moment, x=0.0):
    moments = " ".join(f'{key}="{moment}"' for key in ("ixx", "iyy", "izz"))
    tensor = f'<inertia {moments} ixy="0" ixz="0" iyz="0"/>'
    return f'<inertial><mass value="{kg}"/><origin xyz="{x} 0 0"/>{tensor}</inertial>'


@functools.cache
def robot_with(*features, folder=None):
    """Return an arm of nine joints with these features, and keep its file in ``folder``."""
    chosen = [FEATURES[feature] for feature in features]
    types, mimics = (
        {joint: law for feature in chosen for joint, law in feature.get(name, {}).items()}
        for name in ("types", "mimics")
    )
    massless = {link for feature in chosen for link in feature.get("massless", ())}
    parts, above = [f'<link name="base">{inertial(40.0, 2.0)}</link>'], "base"
    for k, axis in enumerate(AXES):
        law = (
            '<mimic joint="j{}" multiplier="{}" offset="{}"/>'.format(*mimics[k])
            if k in mimics
            else ""
        )
        place = f'<origin xyz="{0.0 if k in massless else 0.2} 0 0.05"/><axis xyz="{axis}"/>'
        ends = f'<parent link="{above}"/><child link="l{k}"/>{place}{WIDE}{law}'
        parts.append(
            f'<link name="l{k}">{"" if k in massless else inertial(0.8, 0.006, 0.1)}</link>'
        )
        parts.append(f'<joint name="j{k}" type="{types.get(k, "revolute")}">{ends}</joint>')
        above = f"l{k}"
    armature = max(feature.get("armature", 0.0) for feature in chosen)
    options = {"fixed_base": all(feature.get("fixed_base", True) for feature in chosen)}
    if armature:
        options["actuators"] = bp.make_actuators(len(AXES), armature=armature)
    text = f'<robot name="featured">{"".join(parts)}</robot>'
    if folder is not None:
        return Robot.load(write(folder, text), **options)
    with tempfile.TemporaryDirectory() as passing:
        return Robot.load(write(Path(passing), text), **options)


def poses(robot):
    """Return the joint positions of a start and a goal (dof,)."""
    bent = np.where(robot.continuous, TURNED, [0.2, 0.7, 0.6, 0.9, -0.8, 0.6, 1.1, 0.7, 0.6])
    ends = bent, bent + 0.3 * np.array([1, 1, -1, 1, 1, -1, 1, 1, -1])
    return tuple(map(robot.coupling.positions, ends))
