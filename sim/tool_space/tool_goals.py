"""Poses that a tool reaches under operational-space control, within the joint limits: by simulation of the model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import batchpid.task_space as ts
from batchpid.arrays.array_types import Array, Float64
from batchpid.errors import InvalidArgumentError
from batchpid.sim.robot.robot import Robot
from batchpid.sim.tool_space.osc_controller import OperationalSpace
from batchpid.task_space.frames import pose_error
from batchpid.task_space.osc_params import TASK_CHOICES, NoDecoupling

SECONDS, TIMESTEP = 3.0, 1 / 250
"""Time that a tool has, and time step of the model [s]."""
ARRIVED = 2e-3
"""Largest error of a pose that was reached [m, rad]."""
SLACK = 1e-3
"""Distance by which a joint may pass a limit [rad or m]."""


def reaches(robot: Robot, control: OperationalSpace, start: Float64, goal: Float64) -> NDArray[np.bool_]:
    """Return whether the tool comes from rest at ``start`` (envs, dof) to ``goal`` (7,) or (envs, 7) (envs,).

    The joints have to stay within their limits, which the law does not know, on the whole way. The model has no
    contact and no friction.
    """
    tree, params = control.tree, control.params
    if not isinstance(params.decoupling, NoDecoupling):
        params = params._replace(discretization=TASK_CHOICES["discretization"]["implicit"])
    k, state = ts.discretise(params, TIMESTEP), control.init(robot, len(start))
    tool = ts.Tool(tree, control.link, control.point)
    goal = np.broadcast_to(goal, (len(start), 7)).astype(np.float64)
    qpos, qvel, inside = start.astype(np.float64), np.zeros(start.shape), np.ones(len(start), bool)

    for _ in range(round(SECONDS / TIMESTEP)):
        state, terms = ts.osc(k, state, tool, ts.OSCInputs(goal, qpos, qvel), ("effort",))
        qvel = qvel + TIMESTEP * ts.forward_dynamics(tree, qpos, qvel, terms.effort)
        qpos = qpos + TIMESTEP * qvel
        inside &= ((qpos >= robot.lower - SLACK) & (qpos <= robot.upper + SLACK)).all(1)
    left: Array = np.abs(pose_error(goal, ts.link_poses(tree, qpos, [tool.link], point=tool.point)[:, 0])).max(1)
    reached: NDArray[np.bool_] = inside & (left <= ARRIVED)
    return reached


def default_goal(robot: Robot, control: OperationalSpace, start: Float64, poses: Float64) -> Float64:
    """Return the first pose (7,) of the tool at ``poses`` (n, dof) that it reaches from all ``start`` (envs, dof).

    Raises
    ------
    InvalidArgumentError
        There is no such pose.
    """
    goals: Float64 = ts.link_poses(control.tree, poses, [control.link], point=control.point)[:, 0]
    for goal in goals:
        reached = reaches(robot, control, start, goal)
        if reached.all():
            return goal
    problem = (
        f"has no default: {len(goals)} poses near the target were tried, and {control.link!r} does not reach the last "
        f"one within the joint limits from {np.count_nonzero(~reached)} of {len(start)} start poses"
    )
    remedy = "give a pose, or start nearer to the robot's target (spread)"
    raise InvalidArgumentError("setpoint", problem, env=int(np.argmin(reached)), remedy=remedy)
