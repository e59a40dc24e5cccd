"""Make a log for ``batchpid identify`` in MuJoCo: the same URDF, with known actuators, delay and encoder noise.

    python examples/mujoco_log.py panda --seconds 10 --out panda.log.csv

It needs the package ``mujoco``. Joints have reflected inertia, viscous and Coulomb friction; of the effort that the PID
law asks for, a share arrives, late. MuJoCo compensates gravity and Coriolis forces, as robots do that are commanded
without them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import batchpid as bp
from sim import Robot
from sim.tuning.identification.excitation import excite


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
    seed: int = 0,
    through: bool = False,
    locked: tuple[int, ...] = (),
) -> dict[str, Any]:
    """Return the columns of a log: time, setpoint, effort, qpos and qvel, (rows, dof)."""
    import mujoco

    spec = mujoco.MjSpec.from_string(robot.urdf)
    spec.option.timestep = timestep
    for joint in robot.all_joints:
        if joint.moves:
            index = robot.joint_names.index(joint.name)
            found = spec.joint(joint.name)
            for name, value in (
                ("armature", truth.armature),
                ("damping", truth.damping),
                ("frictionloss", truth.friction),
            ):
                value = float(value[index])
                setattr(found, name, value if np.ndim(getattr(found, name)) == 0 else [value, 0, 0])
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    model = spec.compile()
    data = mujoco.MjData(model)
    order = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
    rng = np.random.default_rng(seed)
    data.qpos[order] = motion.position[0]
    controller = bp.BatchPID(params, 1, dt=timestep, joint_names=robot.joint_names)
    steps = round(motion.time[-1] / timestep)
    sampled = np.stack(
        [np.interp(np.arange(steps) * timestep, motion.time - motion.time[0], q) for q in motion.position.T], 1
    )
    past = np.zeros((int(np.ceil(truth.delay / timestep)) + 2, robot.dof))
    whole, part = divmod(truth.delay / timestep, 1.0)
    rows = []
    for step in range(steps):
        mujoco.mj_forward(model, data)
        measured = data.qpos[order] + truth.noise * rng.standard_normal(robot.dof)
        asked = controller(sampled[step], measured[None])[0]
        passive = data.qfrc_bias[order].copy()
        if compensate and through:
            asked = asked + passive
        past = np.roll(past, 1, axis=0)
        past[0] = asked
        late = (1 - part) * past[int(whole)] + part * past[int(whole) + 1]
        effort = truth.strength * late + truth.bias
        if compensate and not through:
            effort = effort + passive
        if step % every == 0:
            rows.append(np.concatenate([[data.time], sampled[step], asked, measured, data.qvel[order]]))
        data.qfrc_applied[order] = effort
        mujoco.mj_step(model, data)
    table = np.array(rows)
    parts = np.split(table[:, 1:], 4, axis=1)
    return {"time": table[:, 0], **dict(zip(("setpoint", "effort", "qpos", "qvel"), parts, strict=True))}


def write(robot: Robot, log: dict[str, Any], path: Path, quantities: tuple[str, ...] = ("setpoint", "qpos")) -> None:
    """Write the columns of ``quantities`` as CSV."""
    names = ["time", *(f"{quantity}:{name}" for quantity in quantities for name in robot.joint_names)]
    table = np.column_stack([log["time"], *(log[quantity] for quantity in quantities)])
    np.savetxt(path, table, delimiter=",", header=",".join(names), comments="", fmt="%.10g")


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", nargs="?", default="panda")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/log.csv"))
    options = parser.parse_args()
    robot = Robot.load(options.robot)
    params = robot.designed("effort")
    log = simulate(robot, plausible(robot, options.seed), excite(robot, options.seconds), params, seed=options.seed)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    write(robot, log, options.out)
    bp.save_params(options.out.with_suffix(".params.yaml"), params, robot.joint_names)
    print(f"written: {options.out}, {options.out.with_suffix('.params.yaml')}")


if __name__ == "__main__":
    main()
