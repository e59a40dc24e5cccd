"""Names of the links and joints that bodies and joints of MuJoCo become."""

from __future__ import annotations

from typing import Any

import mujoco

from batchpid.arrays.array_types import MjModel

ALONE = "engine 'mujoco' alone simulates"
"""Beginning of what findings say of elements that have no equivalent in a URDF."""
MOVING = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
"""Types of joints with one degree of freedom."""


def label(element: Any) -> str:
    """Return the quoted name of an element of a model, or its number if it has none."""
    return repr(element.name or f"number {element.id}")


class Names:
    """Names of the ``bodies`` and of the hinges and slides among the ``joints``, by their numbers in the model.

    A body or joint without a name gets one of its number. :meth:`leave_out` removes the joints of other objects.
    """

    def __init__(self, model: MjModel) -> None:
        self._types, self._bodies, self._roots = model.jnt_type, model.jnt_bodyid, model.body_rootid
        self._left_out: set[int] = set()
        given = [model.body(body).name for body in range(1, model.nbody)]
        self._links, self._joints = {"world", *given}, {model.joint(joint).name for joint in range(model.njnt)}
        self.bodies = {0: "world"}
        self.bodies |= {body: name or self.new_link(f"body{body}") for body, name in enumerate(given, start=1)}
        self.joints = {
            joint: model.joint(joint).name or self.new_joint(f"joint{joint}")
            for joint in range(model.njnt)
            if int(model.jnt_type[joint]) in MOVING
        }

    def is_slide(self, joint: int) -> bool:
        """Return whether a joint is a slide, not a hinge."""
        return bool(self._types[joint] == mujoco.mjtJoint.mjJNT_SLIDE)

    def leave_out(self, bodies: set[int]) -> None:
        """Remove the joints of ``bodies``, children of the world, and of the bodies below them."""
        self._left_out = bodies
        self.joints = {joint: name for joint, name in self.joints.items() if self.is_of_robot(self._bodies[joint])}

    def is_of_robot(self, body: Any) -> bool:
        """Return whether a body, the world included, is none of those that were left out, nor below one."""
        return int(self._roots[body]) not in self._left_out

    def new_link(self, name: str) -> str:
        """Return ``name``, with a number if a link has it."""
        return _new(name, self._links)

    def new_joint(self, name: str) -> str:
        """Return ``name``, with a number if a joint has it."""
        return _new(name, self._joints)


def _new(name: str, taken: set[str]) -> str:
    new, number = name, 2
    while new in taken:
        new, number = f"{name}_{number}", number + 1
    taken.add(new)
    return new
