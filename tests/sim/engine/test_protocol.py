"""Any engine whose packs have the members that the loop uses runs in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from identical import assert_identical
from robots import load_bundled

import batchpid as bp
import batchpid.sim.engine.protocol as engines
from batchpid.errors import InvalidArgumentError
from batchpid.motors.friction import Friction
from batchpid.sim import Runner, RunnerOptions

PANDA = load_bundled("panda")
PANDA.has_ground  # noqa: B018
DT, N = 1e-3, 3


class DoubleIntegrators:
    """Pack whose joints have unit inertia: q'' = u, by the semi-implicit Euler method."""

    steps_natively = False

    def __init__(self, spec, size, first_env):
        self.spec, self.size, self.first_env, self.dof = spec, size, first_env, len(spec.joints)
        self.qf = np.zeros((size, self.dof))
        self.friction, self.armature = Friction(), np.zeros((1, self.dof))
        self._state, self._moves = np.zeros((2, size, self.dof)), np.ones((size, 1))

    def read_qpos(self):
        return self._state[0].copy()

    def read_qvel(self):
        return self._state[1].copy()

    def passive_force(self, gravity, coriolis):
        return np.zeros_like(self.qf)

    def write_qf(self, effort):
        self.qf[...] = effort

    def update_constraint(self, rows=slice(None)):
        pass

    def step(self):
        qpos, qvel = self._state
        qvel += self.spec.timestep * self._moves * self.qf
        qpos += self.spec.timestep * qvel

    def write_state(self, rows, qpos, qvel, base=None):
        self._state[0, rows], self._state[1, rows], self.qf[rows] = qpos, qvel, 0.0

    def suspend(self, mask):
        self._moves = ~mask[:, None]

    def write_joints(self, actuators, rows=None):
        assert actuators is None

    def vary(self, rows, variation):
        raise AssertionError

    def read_state(self):
        return np.hstack(self._state)

    def write_state_rows(self, states):
        self._state[...] = np.split(states[:, : 2 * self.dof], 2, axis=1)

    def read_poses(self):
        return []

    def close(self):
        self._state = self._state[:, :0]


@dataclass(frozen=True)
class Solver:
    """Settings of the toy."""

    order: int


ENGINE = engines.Engine(
    name="toy",
    title="Toy",
    capabilities=frozenset({"complete_state"}),
    physics={"accurate": Solver(1)},
    group_size=4,
    make_pack=lambda spec, size, first_env=0, **_: DoubleIntegrators(spec, size, first_env),
    native_obstacle=lambda: "a toy",
)


@pytest.fixture
def toy(monkeypatch):
    """Make the toy the engine of all runners of this process."""
    monkeypatch.setitem(engines.MODULES, "mujoco", __name__)


def runner(**options):
    params = bp.make_params(PANDA.dof, kp=100.0, ki=30.0, kd=20.0, effort_limit=5.0)
    options = {"workers": 0, "timestep": DT, "compensate": "none"} | options
    return Runner(PANDA, N, params=params, **options)


def setpoints(ticks=30):
    noise = np.random.default_rng(0).uniform(-0.02, 0.02, (ticks, N, PANDA.dof))
    return np.clip(PANDA.start + noise, PANDA.lower, PANDA.upper)


@pytest.mark.usefixtures("toy")
def test_another_engine_runs_in_the_loop_as_the_law_on_it_alone_does():
    table = setpoints()
    with runner() as mine:
        rollout = mine.rollout(table)
        params, substeps = mine.params, mine.substeps
    qpos, qvel = np.tile(PANDA.start, (N, 1)), np.zeros((N, PANDA.dof))
    state = bp.init(params, qpos)
    for tick, setpoint in enumerate(table):
        for _ in range(substeps):
            state, effort = bp.step(params, state, setpoint, qpos, DT)
            qvel = qvel + DT * effort
            qpos = qpos + DT * qvel
        np.testing.assert_allclose(rollout.qpos[tick], qpos, rtol=0, atol=1e-6)
        np.testing.assert_allclose(rollout.effort[tick], effort, rtol=0, atol=1e-4)
    assert np.ptp(rollout.qpos, axis=0).min() > 1e-3


@pytest.mark.usefixtures("toy")
def test_its_envs_are_suspended_reset_and_restored_from_its_rows():
    table = setpoints()
    table[3, 1] = np.nan
    with runner(on_invalid_input="contain") as mine:
        with pytest.warns(UserWarning, match="env 1"):
            before = mine.rollout(table[:10])
        assert before.ok[-1].tolist() == [True, False, True]
        snapshot = mine.snapshot()
        assert snapshot.rows["engine"].shape == (N, 2 * PANDA.dof)
        went_on = mine.rollout(table[10:])
        np.testing.assert_array_equal(went_on.qpos[-1, 1], before.qpos[-1, 1])
        mine.restore(snapshot)
        assert_identical(went_on, mine.rollout(table[10:]))
        assert mine.reset(mask=[False, True, False]).ok.all()


@pytest.mark.usefixtures("toy")
def test_what_it_cannot_do_is_an_error_with_a_remedy():
    problem = "build: .*'build'.*'toy' does not have.*use the engine"
    with pytest.raises(InvalidArgumentError, match=problem):
        RunnerOptions(PANDA, N, build=print)
