"""Scene of an MJCF file for MuJoCo: the file itself, in place of a robot built from a URDF.

Actuators, sensors, keyframes, cameras, lights, tuples, and the gravity compensation of the robot's
bodies are removed.
Friction, damping and armature of the robot's joints are set later. The runner sets time step,
integrator, solver and gravity. All other elements are unchanged, friction and impedance of contacts
and limits included.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from batchpid.arrays.array_types import Document, Float64, MjModel, MjSpec
from batchpid.errors import RobotError
from batchpid.sim.description.merging import coupling_of
from batchpid.sim.description.mjcf import compile_scene, home
from batchpid.sim.description.mjcf_bodies import RobotInFile
from batchpid.sim.description.tables import MjcfFile
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.task_space.frames import inverse, matrix_of, rotate

REMOVED = ("tuples", "sensors", "actuators", "keys", "cameras", "lights")
"""Elements of a file that a scene does not have."""


_OF_CONTACTS = (
    "material",
    "condim",
    "priority",
    "friction",
    "solmix",
    "solref",
    "solimp",
    "margin",
    "gap",
)
"""Attributes of a geom that a default class may set, for contacts and for its appearance."""
_EVERYTHING = 2**31 - 1
"""Mask of a geom that collides with every geom that collides at all."""


class BodyFrame(NamedTuple):
    """Frame of a simulated link in the frame of its body, and the numbers of the bodies welded to
    this body.
    """

    position: Float64
    wxyz: Float64
    welded: tuple[int, ...]


def file_scene(
    spec: SceneSpec, file: MjcfFile
) -> tuple[MjSpec, dict[str, str], dict[str, BodyFrame], str, Float64]:
    """Return the scene of ``file``, without the options of ``spec``; the body of each simulated
    link; the frame of the link in this body; the body of a floating base, or ""; and armature and
    damping (2, dof) that the file's joints have in addition to the robot's description, in which
    leaders include their followers.

    Raises RobotError if the file has changed since the robot was loaded.
    """
    compiled = compile_scene(Path(file.path))
    scene, model = compiled.scene, compiled.model
    if compiled.content != file.content:
        raise RobotError(
            f"{file.path}: has changed since the robot was loaded; load the robot again"
        )
    names = RobotInFile(model, Path(file.path), [])
    robot = {body: name for body, name in names.bodies.items() if names.is_of_robot(body)}
    for joint in scene.joints:
        joint.name = names.joints.get(joint.id, joint.name)
    for body in scene.bodies[1:]:
        body.name = names.bodies[body.id]
        body.gravcomp *= body.id not in robot
        body.sleep = mujoco.mjtSleepPolicy.mjSLEEP_AUTO  # no body sleeps
    for element in [part for kind in REMOVED for part in getattr(scene, kind)]:
        scene.delete(element)
    root = ""
    start = _start(model)
    for joint in scene.joints:
        if joint.type != mujoco.mjtJoint.mjJNT_FREE or joint.parent.id not in robot:
            continue
        root = joint.parent.name
        if spec.fixed_base:
            start["qpos"] = np.delete(start["qpos"], model.jnt_qposadr[joint.id] + np.arange(7))
            start["qvel"] = np.delete(start["qvel"], model.jnt_dofadr[joint.id] + np.arange(6))
            scene.body(root).pos = np.zeros(3)
            root = ""
            scene.delete(joint)
    # With it a reset puts the whole scene to its start, objects included.
    scene.add_key(name="start", **start)
    _set_pairs(scene, spec.ignored, {*robot.values()})
    number = {name: joint for joint, name in names.joints.items()}
    dofs = model.jnt_dofadr[[number[joint.name] for joint in spec.joints]]
    terms = np.array(
        [_of_followers(table[dofs], spec) for table in (model.dof_armature, model.dof_damping)]
    )
    bodies, frames = _frames(model, robot, spec)
    return scene, bodies, frames, root, terms


def check_links(spec: SceneSpec, file: MjcfFile, links: Iterable[str]) -> None:
    """Raise RobotError for a link that MuJoCo does not have: several joints of one body have links
    between them.
    """
    for link in links:
        if spec.simulated.links[link].link not in file.bodies:
            problem = (
                f"link {link!r} lies between two joints of one body, and is no body of its own in"
                " MuJoCo"
            )
            raise RobotError(
                f"{file.path}: {problem}; name the link of the body for sensors and payloads"
            )


def set_ground(scene: MjSpec, ground: bool) -> None:
    """Switch contacts with the planes of the world on or off. For on, a scene without planes gets
    one at height 0.
    """
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    # A <pair> makes geoms collide whatever their masks say.
    paired = {name for pair in scene.pairs for name in (pair.geomname1, pair.geomname2)}
    planes = [
        geom
        for geom in scene.worldbody.geoms
        if geom.type == plane and (geom.contype or geom.conaffinity or geom.name in paired)
    ]
    if ground and not planes:
        added = scene.worldbody.add_geom(type=plane, size=[0, 0, 1])
        plain = mujoco.MjSpec().worldbody.add_geom()
        for name in _OF_CONTACTS:  # the file's default class would apply otherwise
            setattr(added, name, getattr(plain, name))
        added.contype = added.conaffinity = _EVERYTHING
    if not ground:
        for geom in planes:
            geom.contype = geom.conaffinity = 0
        for pair in list(scene.pairs):
            if {pair.geomname1, pair.geomname2} & {geom.name for geom in planes}:
                scene.delete(pair)


def _start(model: MjModel) -> Document:
    """Return the keyframe of the start: "home" in the file, or its reference pose."""
    if (key := home(model)) is None:
        return {"qpos": model.qpos0, "qvel": np.zeros(model.nv)}
    return {
        name: getattr(model, f"key_{name}")[key].ravel()
        for name in ("qpos", "qvel", "mpos", "mquat")
    }


def _set_pairs(scene: MjSpec, ignored: Iterable[tuple[str, str]], robot: set[str]) -> None:
    """Exclude exactly those pairs of the robot's bodies that do not collide."""
    # The file may exclude other pairs than the robot's options.
    for exclude in list(scene.excludes):
        if {exclude.bodyname1, exclude.bodyname2} <= robot:
            scene.delete(exclude)
    for first, second in ignored:
        if {first, second} <= robot:
            scene.add_exclude(bodyname1=first, bodyname2=second)


def _frames(
    model: MjModel, robot: dict[int, str], spec: SceneSpec
) -> tuple[dict[str, str], dict[str, BodyFrame]]:
    """Return the body of each simulated link and the frame of the link in it; of merged bodies the
    first counts.

    A body's link has the body's axes, and its origin at the anchor of the body's last hinge.
    """
    placements = spec.simulated.links
    names = dict[str, str]()
    frames: dict[str, BodyFrame] = {}
    for body, name in robot.items():
        if name not in placements:  # the world, if the robot does not include it
            continue
        link, position, wxyz = placements[name]
        if link in frames:
            frames[link] = frames[link]._replace(welded=(*frames[link].welded, body))
            continue
        joints = np.flatnonzero(model.jnt_bodyid == body)
        hinges = joints[-1:][model.jnt_type[joints[-1:]] == mujoco.mjtJoint.mjJNT_HINGE]
        if len(hinges):
            anchor = model.jnt_pos[hinges[0]].copy()
        else:
            anchor = np.zeros(3)
        back = inverse(wxyz)
        names[link], frames[link] = (
            name,
            BodyFrame(anchor - rotate(matrix_of(back), position), back, ()),
        )
    return names, frames


def _of_followers(values: Float64, spec: SceneSpec) -> Float64:
    """Return the armature or damping (dof,) that moves from leaders to their followers: d_f and
    -m^2 d_f.
    """
    coupling = coupling_of(spec.joints)
    terms = np.zeros(len(values))
    follower = coupling.followers
    terms[follower] = values[follower]
    np.subtract.at(
        terms, coupling.leader[follower], coupling.multiplier[follower] ** 2 * values[follower]
    )
    return terms
