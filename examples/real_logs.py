"""Make logs as real robots leave them, one for each kind of controller, and print the commands that
identify them.

    python examples/real_logs.py --out out/real

A bar hangs on a hinge in three robots, with the same motor: under torques, as a hobby servo that is
driven by a voltage, and under a velocity loop that logs neither setpoints nor torques but currents.
docs/sim-to-real.md says why the command is what it is.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import batchpid as bp
from batchpid.sim import Robot, Runner

DT = 1e-3
"""Time step of the controllers [s]."""
URDF = """<robot name="hinge"><link name="base"/>
<link name="bar"><inertial><origin xyz="0 0 -0.2"/><mass value="0.8"/>
<inertia ixx="0.012" ixy="0" ixz="0" iyy="0.012" iyz="0" izz="0.001"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="bar"/><origin xyz="0 0 1"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="12" velocity="20"/></joint></robot>"""
MOTOR = {"armature": 0.02, "viscous": 0.1, "coulomb": 0.15, "command_delay": 0.004}
"""The motor of all three robots."""
STRENGTH = {"torque": 0.9, "servo": 0.5, "velocity": 1.0}
"""Share of the torque that is delivered; of the servo torque per volt, kt / R [N m / V]."""


def wave(seconds: float) -> np.ndarray:
    """Return positions (rows, 1) [rad] that sweep slow and fast."""
    time = DT * np.arange(round(seconds / DT))
    return (0.9 * np.sin(4 * time + 5 * np.sin(0.8 * time)) * np.minimum(time, 1))[:, None]


def move(robot: Robot, kind: str, commands: np.ndarray, params: bp.PIDParams | None):
    """Return times, measured positions, and the efforts that acted before each (rows, 1), under
    ``commands``.
    """
    motor = bp.make_actuators(1, strength=STRENGTH[kind], **MOTOR)
    options = {
        "control": "effort" if params is None else "pid",
        "params": params,
        "actuators": motor,
    }
    with Runner(
        robot, 1, workers=0, timestep=DT, substeps=1, compensate="none", **options
    ) as runner:
        begin = runner.reset(np.zeros((1, 1)))
        rollout = runner.rollout(commands[:, None])
    qpos, effort = (
        np.concatenate([first, later[:, 0]])[:-1]
        for first, later in ((begin.qpos, rollout.qpos), (begin.effort, rollout.effort))
    )
    encoder = 2 * np.pi / 2**16  # its resolution
    return DT * np.arange(len(qpos)), encoder * np.rint(qpos / encoder), effort


def torque(robot: Robot, out: Path, seconds: float) -> list[str]:
    """Write the torques that were commanded, gravity included: the robot itself adds nothing."""
    held = 9.81 * 0.8 * 0.2 * np.sin(wave(seconds))
    time, qpos, _ = move(robot, "torque", held, None)
    _write(out / "torque.csv", time=time, **{"effort:hinge": held, "qpos:hinge": qpos})
    return ["--compensate", "none", "--hold"]


def servo(robot: Robot, out: Path, seconds: float) -> list[str]:
    """Write goals and positions of a servo whose gain is in volts per rad, and whose limit is the
    supply of 12 V.
    """
    params = bp.make_params(1, kp=30.0, effort_limit=12.0, anti_windup="none")
    bp.save_params(out / "servo.yaml", params, robot.joint_names)
    time, qpos, _ = move(robot, "servo", wave(seconds), params)
    _write(out / "servo.csv", time=time, **{"setpoint:hinge": wave(seconds), "qpos:hinge": qpos})
    return ["--gains", str(out / "servo.yaml"), "--compensate", "none"]


def velocity(robot: Robot, out: Path, seconds: float) -> list[str]:
    """Write positions, and currents times the drive gain, at 500 Hz."""
    params = bp.make_params(1, kp=60.0, kd=3.0, effort_limit=12.0)
    time, qpos, effort = move(robot, "velocity", wave(seconds), params)
    _write(
        out / "velocity.csv",
        time=time[::2],
        **{"measured_effort:hinge": effort[::2], "qpos:hinge": qpos[::2]},
    )
    return ["--compensate", "none"]


def _write(path: Path, **columns: np.ndarray) -> None:
    table = np.column_stack([*columns.values()])
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")


def main() -> None:
    """Write the logs and print the commands."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/real"))
    parser.add_argument("--seconds", type=float, default=4.0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "hinge.urdf").write_text(URDF)
    robot = Robot.load(options.out / "hinge.urdf")
    for kind in (torque, servo, velocity):
        flags = kind(robot, options.out, options.seconds)
        log = options.out / f"{kind.__name__}.csv"
        words = [options.out / "hinge.urdf", log, *flags, "--timestep", f"{DT:g}", "--no-payload"]
        print("batchpid identify", *words)


if __name__ == "__main__":
    main()
