"""Kinematics, dynamics and control in the space of a tool: pure functions of a :class:`RigidTree`.

Arrays are (envs, dof), or have any other leading axes; poses are (..., 7): a position and a
quaternion (w, x, y, z); twists, wrenches and Jacobians have linear parts first. NumPy computes in
float64; JAX's arrays keep their dtype.
"""

from batchpid.task_space.inverse_kinematics import (
    IKResult,
    inverse_kinematics,
)
from batchpid.task_space.operational_space import init, osc, task_dynamics
from batchpid.task_space.osc_params import OSCParams, make_osc_params
from batchpid.task_space.osc_state import (
    OSCInputs,
    OSCState,
    OSCTerms,
    TaskDynamics,
    Tool,
)
from batchpid.task_space.rigid_tree import RigidTree
from batchpid.task_space.tree_quantities import (
    bias,
    forward_dynamics,
    inverse_dynamics,
    jacobian,
    jacobian_rate,
    link_poses,
    mass_matrix,
)

__all__ = [
    "IKResult",
    "OSCInputs",
    "OSCParams",
    "OSCState",
    "OSCTerms",
    "RigidTree",
    "TaskDynamics",
    "Tool",
    "bias",
    "forward_dynamics",
    "init",
    "inverse_dynamics",
    "inverse_kinematics",
    "jacobian",
    "jacobian_rate",
    "link_poses",
    "make_osc_params",
    "mass_matrix",
    "osc",
    "task_dynamics",
]
