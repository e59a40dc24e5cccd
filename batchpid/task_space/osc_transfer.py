"""Bumpless transfer to operational-space control, from other control or from other gains."""

from __future__ import annotations

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import clip, namespace
from batchpid.errors import InvalidArgumentError
from batchpid.task_space.operational_space import in_frame, posture_acceleration, task_acceleration
from batchpid.task_space.osc_coefficients import discretise
from batchpid.task_space.osc_params import NoDecoupling, OSCParams, PartialDecoupling
from batchpid.task_space.osc_state import OSCInputs, OSCState, TaskDynamics
from batchpid.task_space.projections import projections
from batchpid.task_space.symmetric import product, quiet, solve


def track(
    params: OSCParams,
    state: OSCState,
    setpoint: Array,
    qpos: Array,
    qvel: Array,
    effort: Array,
    dt: Array,
    dynamics: TaskDynamics,
    *,
    twist: Array = None,
    acceleration: Array = None,
    feedforward: Array = None,
) -> OSCState:
    """Return a state with which the next step, on the same inputs, gives ``effort`` (envs, dof) [N m or N].

    ``effort`` is the last one of another controller, such as a joint PID, or of other gains. In the model it gives the
    joints the acceleration q'' = M^-1 (effort - h - feedforward). The integral is chosen so that the task asks for the
    tool's share of q''; the posture is chosen so that the joints ask for the rest, in the null space and outside the
    chain. A load that the model does not know is thus held by the integral and the posture.

    The next effort differs from ``effort`` where the integral or an effort is at its limit, a joint has no posture
    stiffness, an axis is not selected, or the pose is near a singularity. For a transfer back to a joint PID, call
    :func:`batchpid.track` with the last effort.

    Raises
    ------
    InvalidArgumentError
        The params have no integral, or partial decoupling.
    """
    if params.integral_gain is None:
        problem = "is off, so no integral can carry the effort over"
        raise InvalidArgumentError("params.integral_gain", problem, remedy="give integral_gain; 0 is allowed")
    if isinstance(params.decoupling, PartialDecoupling):
        problem = "'partial' has an inertia that does not move the tool by its acceleration"
        raise InvalidArgumentError("params.decoupling", problem, remedy="use 'full' or 'none'")
    k, mass, bias = discretise(params, dt), dynamics.mass_matrix, dynamics.bias
    inputs = OSCInputs(setpoint, qpos, qvel, twist, acceleration)
    xp = namespace(*k, *dynamics, *inputs, effort)
    with quiet():
        known = bias if feedforward is None else bias + feedforward
        qacc = solve(mass, (effort - known)[..., None])[..., 0]
        stiff = k.posture_kp > 0
        rest = qacc - posture_acceleration(k, dynamics, qpos, qpos, qvel)[0]
        posture = qpos + xp.where(stiff, rest / xp.where(stiff, k.posture_kp, 1.0), 0.0)
        task = in_frame(k, dynamics, inputs)
        wanted = product(task.dynamics.jacobian, qacc) + task.dynamics.jacobian_rate
        if isinstance(k.decoupling, NoDecoupling):
            wanted = projections(k._replace(decoupling=None), task.dynamics, wanted, 0 * qpos).force
        integral = wanted - task_acceleration(k, task)
        return OSCState(posture, clip(integral, -k.integral_limit, k.integral_limit, xp))
