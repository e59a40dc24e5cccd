"""Result of an identification: motors with their intervals, as plain values and as actuators."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import batchpid as bp
from batchpid.arrays.array_types import Document, Float64
from batchpid.checks.validate import choice, integer
from batchpid.errors import InvalidArgumentError
from batchpid.sim.identification.confidence_region import KEY, Region
from batchpid.sim.identification.diagnosis import Diagnosis
from batchpid.sim.identification.held_out import ASSUMED
from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.statistics import INTERVAL, Uncertainty
from batchpid.sim.identification.unknowns import ADDED, DESCRIBED, KINDS, Unknowns, kind_of
from batchpid.sim.robot.robot import Robot
from batchpid.sim.robot.urdf_export import to_urdf

SHORT = 30.0
"""Length of a log [s] below which intervals hold for its motion only."""


class Fit(NamedTuple):
    """Position errors along a simulated stretch of a log: measured less simulated positions [rad or m]."""

    log: int
    """Number of the log."""
    time: Float64
    """Times (rows,) [s]."""
    fitted: NDArray[np.bool_]
    """Fitted rows; the others were held out (rows,)."""
    before: Float64
    """Errors of the robot as described (rows, joints)."""
    after: Float64
    """Errors of the robot as identified."""


class Identification(NamedTuple):
    """Motors that explain the logs, with their uncertainty."""

    robot: Robot
    joints: tuple[int, ...]
    """Numbers of the joints that the logs hold."""
    unknowns: Unknowns
    estimate: Float64
    """Point that was found (unknowns,)."""
    uncertainty: Uncertainty
    held_out_error: tuple[float, float]
    """Root mean square of the position error [rad or m] on the held-out part of the logs, of the robot as described and
    as identified; inf if the simulation diverges."""
    misfits: Float64
    """Held-out residuals over the noise of the sensors (joints,): about 1 if the model explains the motion."""
    noise: Float64
    """Root mean square of the residuals (joints,) [rad or m]."""
    drive: LoggedDrive
    """Control of the robot, as assumed or found."""
    settings: Document
    """Logs, options and versions, for the record."""
    fits: tuple[Fit, ...]
    """Errors along each stretch of the logs that was simulated."""
    diagnosis: Diagnosis
    """Links whose masses seem off, and the stretch of the logs that disagrees most."""

    def interval(self, kind: str, joint: int | None = None) -> tuple[float, float, float] | None:
        """Return estimate, lower and upper end of the 95 % interval; None if the logs do not identify the unknown.

        ``kind`` is a name of :data:`batchpid.sim.identification.unknowns.KINDS`: "armature", "damping", "friction",
        "strength" or "bias" of a ``joint``, by its number among :attr:`joints`; or "delay", "stopping" or "payload",
        without joint. Fits with further effects also have kinds of
        :data:`batchpid.sim.identification.unknowns.ADDED`, each of a joint.

        Raises
        ------
        InvalidArgumentError
            The logs do not hold that joint, or there is no such unknown.
        """
        kind = choice("kind", kind, list(dict.fromkeys(name for name, _ in self.unknowns.names)))
        if kind_of(kind).per_joint != (joint is not None):
            remedy = f"give its number, 0 to {len(self.joints) - 1}" if kind_of(kind).per_joint else "leave it out"
            raise InvalidArgumentError("joint", f"does not go with {kind!r}", value=joint, remedy=remedy)
        if joint is not None:
            joint = integer("joint", joint, 0, len(self.joints) - 1)
        if (kind, joint) not in self.unknowns.names:
            return None
        index = self.unknowns.names.index((kind, joint))
        return self._row(index) if self.uncertainty.identified[index] else None

    def _row(self, index: int) -> tuple[float, float, float]:
        """Return estimate, lower and upper end of the 95 % interval of an unknown, however wide."""
        value, half = self.estimate[index], INTERVAL * self.uncertainty.deviation[index]
        low, high = self.unknowns.low[index], self.unknowns.high[index]
        return float(value), float(max(value - half, low)), float(min(value + half, high))

    @property
    def not_identified(self) -> list[str]:
        """Unknowns that the logs do not identify, e.g. "elbow: strength"."""
        of_joints, others = self.missing()
        return [f"{joint}: {kind}" for joint, kinds in of_joints.items() for kind in kinds] + others

    def missing(self) -> tuple[dict[str, list[str]], list[str]]:
        """Return the kinds of unknowns that the logs do not identify, by joint, and the others: delay and payload."""
        of_joints: dict[str, list[str]] = {}
        others = []
        for (kind, joint), known in zip(self.unknowns.names, self.uncertainty.identified, strict=True):
            if not known and joint is not None:
                of_joints.setdefault(self.robot.joint_names[self.joints[joint]], []).append(kind)
            elif not known and kind != "stopping":
                others.append(kind)
        return of_joints, others

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write :meth:`actuators` to a .yaml or .json file: all values, with their intervals and the names of the logs.

        The values are a joint optimum, and correlated: all are kept, also those whose interval is wide.
        """
        of_joints, others = self.missing()
        document, motors = self.document(), self.unknowns.motors(self.estimate[None])
        names = [self.robot.joint_names[number] for number in self.joints]
        logged = set(names)
        own = zip(self.robot.joint_names, self.robot.independent, strict=True)
        about = {
            "identified_from": self.settings["logs"],
            "held_out_error": document["held_out_error"],
            "misfit": document["misfit"],
            ASSUMED: self.drive.assumptions
            | {kind: float(motors[kind][0, 0]) for kind in ("stopping", "payload")}
            | ({"slew": dict(zip(names, motors["slew"][0].tolist(), strict=True))} if "slew" in motors else {}),
            "intervals": document["joints"]
            | {kind: document[kind] for kind, joint in self.unknowns.names if joint is None and kind in document},
            KEY: self.region.to_dict(),
            "not_well_determined": of_joints | ({"all joints": others} if others else {}),
            "did_not_move_hence_ideal": self.settings["still"],
            "not_in_the_logs_hence_ideal": [
                name for name, free in own if free and name not in logged and name not in self.settings["still"]
            ],
        }
        bp.save_actuators(path, self.actuators(), self.robot.joint_names, about)

    @property
    def region(self) -> Region:
        """Joint confidence region of all unknowns."""
        joints = [self.robot.joint_names[number] for number in self.joints]
        names = tuple((kind, None if joint is None else joints[joint]) for kind, joint in self.unknowns.names)
        return Region(names, self.estimate, self.uncertainty.deviation, self.uncertainty.correlation)

    def corrected_urdf(self) -> str:
        """Return the URDF of the robot with the masses of :attr:`diagnosis`, and tensors in proportion.

        Raises
        ------
        InvalidArgumentError
            No link's mass seems off.
        RobotError
            The robot's file cannot be read, or has changed since.
        """
        if not self.diagnosis.links:
            remedy = "leave the option out; the robot's description is as good as these logs tell"
            raise InvalidArgumentError("corrected_urdf", "no link's mass seems off", remedy=remedy)
        return to_urdf(self.robot, mass_factors=self.diagnosis.links).text

    def document(self) -> Document:
        """Return the result as plain values: for each unknown the estimate and its 95 % interval, however wide.

        "not_identified" names the unknowns that are not well determined.
        """

        def row(kind: str, joint: int | None = None) -> list[float]:
            if (kind, joint) not in self.unknowns.names:
                return [kind_of(kind).neutral] * 3
            return list(self._row(self.unknowns.names.index((kind, joint))))

        document: Document = {
            "joints": {
                self.robot.joint_names[number]: {kind: row(kind, joint) for kind in self.unknowns.per_joint}
                for joint, number in enumerate(self.joints)
            }
        }
        document |= {kind: row(kind) for kind, joint in self.unknowns.names if joint is None and kind != "stopping"}
        return document | {
            "held_out_error": [value if np.isfinite(value) else None for value in self.held_out_error],
            "misfit": self.misfit if np.isfinite(self.misfit) else None,
            "not_identified": self.not_identified,
            "strength_taken_as_1": self.strength_taken,
            "singular_values": self.uncertainty.singular_values.tolist(),
            "noise": self.noise.tolist(),
            "diagnosis": self.diagnosis.to_dict(),
            "compensation": "through the motors" if self.drive.through else self.drive.compensate,
            "about": self.settings,
        }

    @property
    def strength_taken(self) -> list[str]:
        """Joints of which the logs show only ratios to the strength: it is taken as 1."""
        if "strength" in self.unknowns.known:
            return []
        known = self.unknowns.joints_of("strength") + self.unknowns.joints_of("gain")
        return [self.robot.joint_names[number] for at, number in enumerate(self.joints) if at not in known]

    @property
    def finds_gains(self) -> bool:
        """True if :meth:`gains` differ from the params of the law that were given."""
        return not {"gain", "kd", "saturation"}.isdisjoint(self.unknowns.per_joint)

    def gains(self) -> bp.PIDParams | None:
        """Return the params of the law that was found, of the logged joints; None for logs of efforts."""
        return self.drive.of(self.unknowns.motors(self.estimate[None])).params

    @property
    def misfit(self) -> float:
        """The largest of :attr:`misfits`."""
        return float(self.misfits.max())

    @property
    def worst_joint(self) -> str:
        """Name of the joint with the largest of :attr:`misfits`."""
        return self.robot.joint_names[self.joints[int(self.misfits.argmax())]]

    @property
    def is_short(self) -> bool:
        """True if there is one log of less than :data:`SHORT`, which shows nothing of other motions, loads and days."""
        return len({fit.log for fit in self.fits}) == 1 and sum(float(np.ptp(fit.time)) for fit in self.fits) < SHORT

    @property
    def explains(self) -> bool:
        """True if the error on the held-out part fell."""
        return self.held_out_error[1] < self.held_out_error[0]

    def actuators(self) -> bp.Actuators:
        """Return the actuators at the point that was found; joints that are not in the logs are ideal.

        Friction is the excess over the friction in the robot's description, at least 0.
        """
        return actuators_at(self.robot, self.joints, self.unknowns, self.estimate)


def actuators_at(robot: Robot, joints: tuple[int, ...], unknowns: Unknowns, theta: Float64) -> bp.Actuators:
    """Return the actuators of ``robot`` at a point (unknowns,); joints that are not in ``joints`` are ideal."""
    found, options = unknowns.motors(theta[None]), dict[str, Any]()
    for name, kind in (KINDS | ADDED).items():
        if kind.field is None or name not in found:
            continue
        column = np.full(robot.dof, kind.neutral)
        if not kind.per_joint:
            column[:] = found[name][0]
        elif name in DESCRIBED:
            column[list(joints)] = np.maximum(found[name][0] - getattr(robot, DESCRIBED[name])[list(joints)], 0.0)
        else:
            column[list(joints)] = found[name][0]
        options[kind.field] = column
    if "static" in options:  # below Coulomb's it has no effect, nor has the Stribeck velocity
        more = options["static"] > options["coulomb"]
        options |= {name: np.where(more, options[name], 0.0) for name in ("static", "stribeck")}
    return bp.make_actuators(robot.dof, **options, joint_names=robot.joint_names)
