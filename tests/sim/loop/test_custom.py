"""The caller's own controllers: called at every sim step, with a state that resets, snapshots and
recovery keep.
"""

import threading

import numpy as np
import pytest
from identical import assert_identical

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import FaultWarning, Runner

N, TICKS = 5, 12


class Law:
    """batchpid's own law with the passive force as feedforward: what control="pid" does with gains
    in efforts.
    """

    def __init__(self, params):
        self.params, self.k = params, None

    def init(self, robot, num_envs, timestep):
        return bp.init(self.params, np.tile(robot.start, (num_envs, 1)).astype(np.float32))

    def __call__(self, state, setpoint, qpos, qvel, passive):
        k = bp.discretise(self.params, 1 / 2000)
        state, terms = bp.advance(k, state, setpoint, qpos, None, None, passive)
        return state, terms.effort


class Counter:
    """Efforts from a state of several parts: the number of steps, and a filtered velocity."""

    def init(self, robot, num_envs, timestep):
        return {"steps": np.zeros(num_envs), "filter": (np.zeros((num_envs, robot.dof)), None)}

    def __call__(self, state, setpoint, qpos, qvel, passive):
        steps, filtered = state["steps"] + 1, 0.9 * state["filter"][0] + 0.1 * qvel
        wave = np.sin(0.01 * steps)[:, None]
        return {
            "steps": steps,
            "filter": (filtered, None),
        }, passive + 5 * wave * setpoint - 0.5 * filtered


def rollout(robot, controller, **options):
    rng = np.random.default_rng(1)
    with Runner(
        robot, N, control=controller, **({"workers": 0, "substeps": 10} | options)
    ) as runner:
        setpoints = robot.start + rng.uniform(-0.1, 0.1, (TICKS, N, robot.dof))
        return runner.rollout(np.clip(setpoints, robot.lower, robot.upper))


def test_the_law_as_a_controller_is_the_pid(panda):
    params = panda.params(setpoint_weight=0.5)
    # MuJoCo rounds the passive force otherwise in Python.
    options = {"engine": "sapien", "params": params}
    ours = rollout(panda, Law(params), **options)
    theirs = rollout(panda, "pid", compensate="gravity+coriolis", **options)
    assert_identical(ours, theirs)
    assert ours.info.control == "Law"
    assert np.ptp(ours.qpos, axis=0).max() > 0.01


class WrongState(Counter):
    def init(self, robot, num_envs, timestep):
        return {"steps": np.zeros(3)}


def test_a_first_state_of_a_wrong_shape_is_refused(panda):
    with pytest.raises(InvalidArgumentError, match=r"control.*steps"):
        Runner(panda, N, control=WrongState(), workers=0)


class NanAtOneJoint(Counter):
    def __init__(self, xp=np):
        self.xp = xp

    def __call__(self, state, setpoint, qpos, qvel, passive):
        bad = (setpoint > 0.9) & (state["steps"] == 6)[:, None]
        return state | {"steps": state["steps"] + 1}, self.xp.where(bad, self.xp.nan, passive)


@pytest.mark.parametrize("how", ["numpy", "jax", "delayed"])
def test_a_fault_names_the_controller_whose_effort_is_nan(panda, how):
    options = {"workers": 0, "substeps": 10, "control": NanAtOneJoint()}
    delay = 0
    if how == "jax":
        jnp = pytest.importorskip("jax.numpy")
        options |= {"backend": "jax", "control": NanAtOneJoint(jnp)}
    if how == "delayed":
        delay = 2
        options["actuators"] = bp.make_actuators(panda.dof, command_delay=delay / 2000)
    setpoint = np.zeros((N, panda.dof))
    setpoint[3, 4] = setpoint[3, 6] = 1.0
    message = (
        r"env 3, 'panda_joint5': the effort that its controller returned is not finite, at"
        r" step"
    )
    with Runner(panda, N, **options) as runner:
        with pytest.warns(FaultWarning, match=message):
            runner.step(setpoint)
        assert runner.backend.startswith("law in JAX") == ("jax" in str(options.get("backend")))
        (fault,) = runner.faults
    assert fault[:2] == (3, 7 + delay)
    assert (fault.joint, fault.cause) == ("panda_joint5", "effort")


def test_efforts_are_limited(panda):
    class Strong(Counter):
        def __call__(self, state, *_):
            return state, np.full((len(state["steps"]), panda.dof), 1e4)

    with Runner(panda, 2, control=Strong(), workers=0) as runner:
        obs = runner.step(np.zeros(panda.dof))
    assert obs.saturated.all()
    np.testing.assert_allclose(obs.effort, np.tile(panda.effort_limit, (2, 1)), rtol=1e-6)


class Writes(Counter):
    """Writes to one of its inputs."""

    def __init__(self, number):
        self.number = number

    def __call__(self, state, *inputs):
        inputs[self.number][...] = 0.5
        return super().__call__(state, *inputs)


@pytest.mark.parametrize("number", range(4), ids=["setpoint", "qpos", "qvel", "passive"])
def test_inputs_are_read_only(panda, number):
    with pytest.raises(Exception, match="read-only"):
        rollout(panda, Writes(number))


class Thrifty:
    """Has views of its inputs and a count as its state, and returns the same arrays for every group
    and call; or copies of all.
    """

    def __init__(self, copies):
        self.copies, self.arrays = copies, {}

    def own(self, *shape):
        if self.copies:
            return np.zeros(shape)
        return self.arrays.setdefault(shape, np.zeros(shape))

    def init(self, robot, num_envs, timestep):
        return [self.own(num_envs, 1), *[np.zeros((num_envs, robot.dof))] * 4]

    def __call__(self, state, *inputs):
        before, *old = state
        changes = [new - kept for new, kept in zip(inputs, old, strict=True)]
        count, effort = self.own(len(before), 1), self.own(*inputs[0].shape)
        count[...] = before + inputs[0][:, :1]
        effort[...] = inputs[3] + count + 20 * changes[0] + 5 * changes[1] + changes[2]
        return [count, *(map(np.copy, inputs) if self.copies else inputs)], effort


@pytest.mark.parametrize("compensate", ["gravity", "none"])
def test_inputs_may_be_kept_and_arrays_used_again(panda, compensate):
    """By a controller of several groups of envs."""
    seen = []
    options = {"workers": 0, "substeps": 3, "compensate": compensate, "engine": "sapien"}
    for copies in (False, True):
        with Runner(panda, 8, control=Thrifty(copies), **options) as runner:
            for tick in range(4):
                setpoints = np.outer(0.01 * tick + np.linspace(0, 0.03, 8), np.ones(9))
                observation = runner.step(setpoints, feedforward=np.full(9, tick))
            seen.append(observation)
    assert_identical(*seen)


class Changes(Counter):
    """Returns another state than it should."""

    def __init__(self, change):
        self.change = change

    def init(self, robot, num_envs, timestep):
        return super().init(robot, num_envs, timestep) | {"count": np.zeros(num_envs, int)}

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return self.change({**state, "steps": state["steps"] + 1}), passive


CHANGES = {
    "rows": (lambda state: state | {"steps": state["steps"][:2]}, "steps"),
    "axes": (lambda state: state | {"steps": state["steps"][:, None]}, "steps"),
    "lost": (lambda state: {"steps": state["steps"], "count": state["count"]}, "filter/0"),
    "more": (lambda state: state | {"more": state["steps"]}, "more"),
    "none": (lambda state: None, "steps|count"),
    "kind": (lambda state: state | {"count": state["count"] + 0.5}, "count"),
}


@pytest.mark.parametrize("backend", ["numpy", "jax"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_state_of_another_kind_is_refused_by_name(panda, change, backend):
    how, entry = CHANGES[change]
    runner = Runner(panda, N, control=Changes(how), workers=0, backend=backend)
    with runner, pytest.raises(InvalidArgumentError, match=f"^control: returned .*({entry})"):
        runner.step(np.zeros(panda.dof))


def test_a_state_keeps_its_dtype(panda):
    wide = Changes(
        lambda state: (
            state | {"steps": state["steps"].astype(np.float32), "count": state["count"] > 0}
        )
    )
    with Runner(panda, N, control=wide, workers=0) as runner:
        runner.step(np.zeros(panda.dof))
        snapshot = runner.snapshot()
        runner.restore(snapshot)
    assert [snapshot.rows[f"control/law/{name}"].dtype for name in ("steps", "count")] == [
        np.float64,
        np.int64,
    ]


class KeepsDynamics:
    """Computed torque, with the dynamics of the robot as an attribute from ``init`` on."""

    def init(self, robot, num_envs, timestep):
        self.dynamics = robot.dynamics()

    def __call__(self, state, setpoint, qpos, qvel, passive):
        acceleration = 100 * (setpoint - qpos) - 20 * qvel
        return state, (self.dynamics.mass_matrix(qpos) * acceleration[:, None]).sum(-1) + passive


def test_a_controller_that_has_run_here_can_be_sent_to_workers(panda):
    controller = KeepsDynamics()
    here = rollout(panda, controller)
    assert_identical(rollout(panda, controller, workers=2), here)


def test_an_error_says_that_a_controller_cannot_be_sent(panda):
    controller = KeepsDynamics()
    controller.lock = threading.Lock()
    with pytest.raises(
        InvalidArgumentError,
        match=r"^options: cannot be sent to a worker: .*; keep objects",
    ):
        rollout(panda, controller, workers=1)
