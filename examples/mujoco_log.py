"""Make a log for ``batchpid identify`` in MuJoCo: the same URDF, with known actuators, delay and
encoder noise.

    python examples/mujoco_log.py panda --seconds 10 --out panda.log.csv

It needs the package ``mujoco``. Joints have reflected inertia, viscous and Coulomb friction; of the
effort that the PID law asks for, a share arrives, late. MuJoCo compensates gravity and Coriolis
forces, as robots do that are commanded without them. The true values are printed, and written to an
actuators file next to the log, for comparison with the result of ``identify``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from batchpid.sim import Robot, to_urdf
from batchpid.sim.identification import excite


class Truth(NamedTuple):
    """Actuators of the simulated robot; arrays are (dof,)."""

    armature: Any
    damping: Any
    friction: Any
    strength: Any
    bias: Any
    delay: float = 3.7e-3
    noise: float = 2 * np.pi / 2**18
    payload: float = 0.0


def plausible(robot: Robot, seed: int = 0) -> Truth:
    """Return actuators drawn in proportion to the robot's inertia and effort limits."""
    rng = np.random.default_rng(seed)
    inertia = np.diagonal(robot.mass_matrix(robot.sample(20)), axis1=1, axis2=2).mean(0)
    limit = robot.design_effort_limit

    def spread(low: float, high: float) -> Any:
        return rng.uniform(low, high, robot.dof)

    return Truth(
        armature=inertia * spread(0.2, 0.6),
        damping=inertia * spread(0.5, 2.0),
        friction=np.minimum(limit * spread(0.01, 0.03), inertia * 3.0),
        strength=np.full(robot.dof, 0.9),
        bias=np.minimum(limit * 0.01, inertia) * rng.uniform(-0.5, 0.5, robot.dof),
    )


def simulate(
    robot: Robot,
    truth: Truth,
    motion: bp.Trajectory,
    params: bp.PIDParams,
    *,
    timestep: float = 1 / 2000,
    every: int = 2,
    compensate: bool = True,
    through: bool = False,
    moving: int | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Return the columns of a log: time (rows,), setpoint, effort, qpos and qvel (rows, moving).

    Parameters
    ----------
    params
        Of the PID law, one entry for each joint of ``robot``.
    every
        Keep every n-th time step.
    compensate, through
        Whether the robot compensates the forces that it has without payload, and whether through
        its motors.
    moving
        Number of joints that move; the others are locked at 0. Default: all.
    seed
        Of the encoder noise.
    """
    import mujoco

    names = robot.joint_names[:moving]
    count = len(names)
    model = _model(robot, truth, names, timestep)
    unloaded = _model(robot, truth._replace(payload=0.0), names, timestep)
    data, own = mujoco.MjData(model), mujoco.MjData(unloaded)
    mujoco.mj_setConst(model, data)
    order = [int(model.joint(name).qposadr[0]) for name in names]
    data.qpos[order] = motion.position[0, :count]
    gains = bp.PIDParams(
        *(leaf[:, :count] if getattr(leaf, "ndim", 0) == 2 else leaf for leaf in params)
    )
    gains = gains._replace(measurement_rate=None)  # the law gets positions alone
    controller = bp.BatchPID(gains, 1, dt=timestep, joint_names=names)
    time = timestep * np.arange(round(motion.time[-1] / timestep))
    setpoints = np.stack(
        [np.interp(time, motion.time - motion.time[0], q) for q in motion.position.T[:count]],
        axis=1,
    )
    strength, bias = truth.strength[:count], truth.bias[:count]
    whole, part = divmod(truth.delay / timestep, 1.0)
    asked = np.zeros((len(time), count))
    rng, rows = np.random.default_rng(seed), []
    for step, setpoint in enumerate(setpoints):
        mujoco.mj_forward(model, data)
        measured = data.qpos[order] + truth.noise * rng.standard_normal(count)
        own.qpos[:], own.qvel[:] = data.qpos, data.qvel
        mujoco.mj_fwdPosition(unloaded, own)
        mujoco.mj_fwdVelocity(unloaded, own)
        passive = own.qfrc_bias[order] if compensate else np.zeros(count)
        asked[step] = controller(setpoint, measured[None])[0] + through * passive
        if step % every == 0:
            rows.append(np.stack([setpoint, asked[step], measured, data.qvel[order]]))
        late, later = (
            asked[step - n] if step >= n else np.zeros(count) for n in (int(whole), int(whole) + 1)
        )
        delivered = strength * ((1 - part) * late + part * later) + bias
        data.qfrc_applied[order] = delivered + (not through) * passive
        mujoco.mj_step(model, data)
    columns = np.array(rows).transpose(1, 0, 2)
    return {
        "time": time[::every],
        **dict(zip(("setpoint", "effort", "qpos", "qvel"), columns, strict=True)),
    }


def _model(robot: Robot, truth: Truth, names: tuple[str, ...], timestep: float) -> Any:
    """Return MuJoCo's model of the robot: no contact, and only the joints ``names`` move."""
    import mujoco

    spec = mujoco.MjSpec.from_string(to_urdf(robot).text)
    spec.option.timestep = timestep
    spec.compiler.fusestatic = False  # so that the tool link, which carries the payload, stays
    for index, name in enumerate(robot.joint_names):
        joint = spec.joint(name)
        if name not in names:
            spec.delete(joint)
            continue
        joint.armature, joint.frictionloss = (
            float(truth.armature[index]),
            float(truth.friction[index]),
        )
        damping = float(truth.damping[index])
        joint.damping = damping if np.ndim(joint.damping) == 0 else [damping, 0, 0]
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    model = spec.compile()
    if truth.payload:
        model.body(robot.kinematic_tree().tool).mass[:] += truth.payload
    return model


def write(
    robot: Robot,
    log: dict[str, Any],
    path: Path,
    quantities: tuple[str, ...] = ("setpoint", "qpos"),
) -> None:
    """Write the columns of ``quantities`` as CSV."""
    joints = robot.joint_names[: log["qpos"].shape[1]]
    names = ["time", *(f"{quantity}:{name}" for quantity in quantities for name in joints)]
    table = np.column_stack([log["time"], *(log[quantity] for quantity in quantities)])
    np.savetxt(path, table, delimiter=",", header=",".join(names), comments="", fmt="%.10g")


def as_actuators(robot: Robot, truth: Truth) -> bp.Actuators:
    """Return the actuators that an identification should find; their friction adds to the
    robot's.
    """
    return bp.make_actuators(
        robot.dof,
        command_delay=truth.delay,
        strength=truth.strength,
        bias=truth.bias,
        coulomb=np.maximum(truth.friction - robot.friction, 0.0),
        viscous=np.maximum(truth.damping - robot.damping, 0.0),
        armature=truth.armature,
        joint_names=robot.joint_names,
    )


def table(robot: Robot, truth: Truth) -> str:
    """Return the true values in the format of the estimates of ``batchpid identify``."""
    kinds = ("armature", "damping", "friction", "strength", "bias")
    width = max(map(len, robot.joint_names))
    lines = [" ".join([f"{'truth, SI units':{width}}", *(f"{kind:>10}" for kind in kinds)])]
    for joint, name in enumerate(robot.joint_names):
        lines.append(
            " ".join(
                [f"{name:{width}}", *(f"{getattr(truth, kind)[joint]:10.4g}" for kind in kinds)]
            )
        )
    return "\n".join([*lines, f"delay of the commands: {1e3 * truth.delay:.4g} ms"])


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("robot", nargs="?", default="panda")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/log.csv"))
    options = parser.parse_args()
    robot = Robot.load(options.robot)
    params, truth = robot.designed("effort"), plausible(robot, options.seed)
    log = simulate(robot, truth, excite(robot, options.seconds), params, seed=options.seed)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    gains, actuators = (
        options.out.with_suffix(suffix) for suffix in (".params.yaml", ".truth.yaml")
    )
    write(robot, log, options.out)
    bp.save_params(gains, params, robot.joint_names)
    bp.save_actuators(
        actuators, as_actuators(robot, truth), robot.joint_names, {"truth_of": options.out.name}
    )
    print(table(robot, truth))
    print(f"\nwritten: {options.out}, {gains}, {actuators}")
    print(f"next: batchpid identify {options.robot} {options.out} --gains {gains}")


if __name__ == "__main__":
    main()
