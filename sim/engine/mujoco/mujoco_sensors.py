"""Sensors of links in MuJoCo: contact forces, and wrenches between a link and its parent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from batchpid.arrays.array_types import Bool, Float64, MjModel, MjsBody, MjSpec, Rows
from batchpid.sim.engine.mujoco.file_scene import BodyFrame
from batchpid.sim.engine.scene_spec import SceneSpec

if TYPE_CHECKING:
    from batchpid.sim.engine.mujoco.model_builder import RobotMj

_FOUND_AND_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND) | 1 << int(
    mujoco.mjtConDataField.mjCONDATA_FORCE
)
_NET_FORCE = 3
"""Reduction mode of MuJoCo's contact sensor: net force of all contacts, along the axes of the
world.
"""
_CONTACT, _WRENCH = 4, 6
"""Numbers of values: contacts and force on the other body of a contact sensor; force and torque of
a wrench.
"""


def contact_bodies(spec: SceneSpec) -> list[str]:
    """Return the simulated link of each link of ``spec.contacts``."""
    return [spec.simulated.links[link].link for link in spec.contacts or ()]


def add_link_sensors(
    scene: MjSpec,
    spec: SceneSpec,
    names: dict[str, str],
    frames: Mapping[str, BodyFrame],
) -> None:
    """Add sensors for the links of ``spec.contacts`` and ``spec.wrenches``.

    ``names`` are the bodies of the links, ``frames`` the frames of links that differ from the
    frames of their bodies.
    """
    kinds, objects = mujoco.mjtSensor, mujoco.mjtObj
    for link in contact_bodies(spec):
        for part in _parts(scene.body(names[link]), {*names.values()}):
            sensor = scene.add_sensor(
                type=kinds.mjSENS_CONTACT,
                objtype=objects.mjOBJ_BODY,
                objname=part.name,
            )
            sensor.intprm[:3] = _FOUND_AND_FORCE, _NET_FORCE, 1
    for link in spec.wrenches or ():
        site = f"{link} (wrench)"
        if (frame := frames.get(link)) is None:
            place = {}
        else:
            place = {"pos": frame.position, "quat": frame.wxyz}
        scene.body(names[link]).add_site(name=site, **place)
        for kind in (kinds.mjSENS_FORCE, kinds.mjSENS_TORQUE):
            scene.add_sensor(
                type=kind,
                objtype=objects.mjOBJ_SITE,
                objname=site,
            )


def _parts(body: MjsBody, others: set[str]) -> Iterator[MjsBody]:
    """Yield the body of a link, and its descendants that belong to the same link, since ``others``
    lacks them.
    """
    yield body
    for child in body.bodies:
        if child.name not in others:
            yield from _parts(child, others)


def wrench_tables(
    robot: RobotMj,
    tables: tuple[NDArray[np.int32], Float64],
    models: Sequence[MjModel],
) -> dict[str, Rows]:
    """Return the tables of the links whose wrenches are measured for ``FreeMotion`` in
    ``free_motion.h``, for robots with the ``tables`` of their tree and these ``models``.
    """
    model = robot.model
    sites = model.sensor_objid[model.sensor_type == mujoco.mjtSensor.mjSENS_FORCE]
    links, welded = model.site_bodyid[sites], model.body_weldid
    movers = model.dof_bodyid[robot.qvel]
    joints = np.full(model.nbody, -1, np.int32)
    joints[movers] = np.arange(len(movers))
    carriers = joints[welded[links]]
    # Frames of the tree with all joints at 0; the last one is the base's, with number -1.
    turns, places = np.tile(np.eye(3), (len(movers) + 1, 1, 1)), np.zeros((len(movers) + 1, 3))
    for joint, ((above, _), row) in enumerate(zip(*tables, strict=True)):
        turns[joint] = turns[above] @ row[:9].reshape(3, 3)
        places[joint] = places[above] + turns[above] @ row[9:12]
    turns, places = turns[carriers], places[carriers]
    # Bodies of a link, and below it.
    inside = np.arange(model.nbody) == links[:, None]
    for body in range(1, model.nbody):
        inside[:, body] |= inside[:, model.body_parentid[body]]
    inside &= welded == welded[links][:, None]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    axes = np.swapaxes(data.site_xmat[sites].reshape(-1, 3, 3), 1, 2) @ turns
    origins = np.einsum("lij,li->lj", turns, data.site_xpos[sites] - places)
    carried = [
        [
            _inertia(variant, bodies, turn, place)
            for bodies, turn, place in zip(inside, turns, places, strict=True)
        ]
        for variant in models
    ]
    return {
        "carriers": carriers,
        "hanging": inside[:, model.body_parentid[movers]].astype(np.int32, order="C"),
        "frames": np.hstack([axes.reshape(-1, 9), origins]),
        "carried": np.array(carried),
    }


def _inertia(model: MjModel, bodies: Bool, turn: Float64, place: Float64) -> Float64:
    """Return mass, center and tensor about it (13,) of ``bodies``, in a frame, with the joints at
    0.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    masses, centers = model.body_mass[bodies], data.xipos[bodies]
    center = masses @ centers / masses.sum()
    apart = centers - center
    axes = data.ximat[bodies].reshape(-1, 3, 3)
    tensor = np.einsum("bik,bk,bjk->ij", axes, model.body_inertia[bodies], axes)
    tensor += np.sum(masses * (apart**2).sum(1)) * np.eye(3) - (masses * apart.T) @ apart
    return np.hstack([masses.sum(), (center - place) @ turn, (turn.T @ tensor @ turn).ravel()])


class MujocoLinkSensors:
    """Indices of the sensors of ``spec`` in the ``size`` sensor values of ``model``; ``bodies`` by
    link.
    """

    def __init__(self, spec: SceneSpec, model: MjModel, bodies: dict[str, int]) -> None:
        ids = model.sensor_objid[model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT]
        owners = ids.copy()
        # A body without a link of its own belongs to the nearest one above it that has one.
        while (lower := ~np.isin(owners, [*bodies.values()])).any():
            owners[lower] = model.body_parentid[owners[lower]]
        self._rows: Sequence[Rows] = [
            np.flatnonzero(np.equal(owners, bodies[link])) for link in contact_bodies(spec)
        ]
        self._contacts = len(owners)
        self._wrenches = len(spec.wrenches or ())
        self.size = int(model.nsensordata)

    def quantities(self, values: Float64) -> dict[str, Float64]:
        """Return the quantities of :meth:`batchpid.sim.engine.protocol.EnginePack.take_sensed` for
        values (M, size).
        """
        of_contacts, of_wrenches = np.split(values, [_CONTACT * self._contacts], axis=1)
        quantities = {}
        if self._rows:
            parts = of_contacts.reshape(-1, self._contacts, _CONTACT)
            rows = np.stack([parts[:, row].sum(1) for row in self._rows], axis=1)
            # The sensor has the force on the other body. From 0, so that there is no negative zero.
            quantities = {"contact_force": 0.0 - rows[..., 1:], "touching": rows[..., 0]}
        if self._wrenches:
            quantities["wrench"] = of_wrenches.reshape(-1, self._wrenches, _WRENCH).copy()
        return quantities
