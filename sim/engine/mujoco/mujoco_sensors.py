"""Sensors of links in MuJoCo: contact forces, and wrenches between a link and its parent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from batchpid.arrays.array_types import Float64, MjModel, MjsBody, MjSpec, Rows
from batchpid.sim.engine.mujoco.file_scene import BodyFrame
from batchpid.sim.engine.scene_spec import SceneSpec

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


def wrench_tables(spec: SceneSpec, added: Mapping[str, Float64], size: int) -> dict[str, Rows]:
    """Return the tables of the links whose wrenches are measured for ``FreeMotion`` in
    ``free_motion.h``, for ``size`` robots with the inertias :attr:`.VariedMasses.added`.
    """
    tree = spec.rigid_tree
    is_fixed = np.array(tree.joint_types) == "fixed"
    parents = np.asarray(tree.parent)
    links = [tree.index(name) for name in spec.wrenches or ()]
    carriers = np.array(tree.link_bodies, np.int32)[links]
    hanging = np.zeros((len(links), tree.dof), np.int32)
    carried = np.zeros((size, len(links), 13))
    for row, link in enumerate(links):
        # The link, and all that fixed joints hold to it.
        inside = np.arange(len(parents)) == link
        for held in np.flatnonzero(is_fixed[1:]) + 1:
            inside[held] |= inside[parents[held]]
        hanging[row] = inside[parents[~is_fixed]]
        part = replace(tree, mass=inside * tree.mass, inertia=inside[:, None, None] * tree.inertia)
        varied = {name: rows for name, rows in added.items() if inside[tree.index(name)]}
        bodies = part.varied(varied) if varied else None
        carried[:, row] = part.inertias(bodies)[..., carriers[row], :]
    frames = tree.bodies.link_frames[links]
    axes = np.swapaxes(frames[..., :3], 1, 2).reshape(-1, 9)
    return {
        "carriers": carriers,
        "hanging": hanging,
        "frames": np.hstack([axes, frames[..., 3]]),
        "carried": carried,
    }


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
