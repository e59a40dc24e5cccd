"""Stages of a sim step against plain Python numbers, one joint at a time, and delays that are whole
numbers of steps. Law, guard, motors and friction have their oracles in test_law_conformance.py and
test_motor_conformance.py.
"""

import math

import numpy as np
import pytest

import batchpid as bp
from batchpid.motors import Coupling, delay
from batchpid.motors.friction import LOOKAHEAD, Friction
from batchpid.stages import Control, Values, stages_of
from batchpid.stages.friction import REFRESH_STEPS
from batchpid.stages.stage import by_name, started, stepped
from batchpid.stages.values import Command, Measured, Model, Step

N, DOF, DT = 3, 2, 1 / 2000
RNG = np.random.default_rng(7)
PARAMS = bp.make_params(DOF, kp=5.0, ki=2.0, kd=0.1, effort_limit=3.0)
NEUTRAL = Control(DT, N, Coupling.of(DOF), PARAMS)


def rows():
    return RNG.normal(0, 2, (N, DOF))


def at(index=0, end=10, command=None, late=False, **parts):
    """Return the values of a sim step of robots at random places."""
    measured = Measured(rows(), rows(), rows())
    command = command or Command(rows(), None, None, rows())
    step = Step(index, end, (end - index - late) * DT)
    return Values(command, measured, measured, DT, step)._replace(**parts)


def run(control, name, values):
    """Return state and values after the stage of a name, which has just started."""
    stage = next(one for one in stages_of(control) if one.name == name)
    state, _ = stage.init(values)
    return stage.step(state, values)


def entries():
    return [(env, joint) for env in range(N) for joint in range(DOF)]


@pytest.mark.parametrize("late", [False, True])
def test_setpoint_moves_with_constant_acceleration_to_the_end_of_the_tick(late):
    for index in range(10):
        values = at(index, command=Command(rows(), rows(), rows(), rows()), late=late)
        command = run(NEUTRAL, "setpoint", values)[1].command
        for env, joint in entries():
            setpoint, rate, acceleration, _ = (part[env, joint] for part in values.command)
            # From the place where the tick ends, backwards in steps of the motion itself.
            for _ in range(10 - index - late):
                setpoint += -DT * rate + DT * DT / 2 * acceleration
                rate -= DT * acceleration
            assert command.setpoint[env, joint] == pytest.approx(setpoint, abs=1e-12)
            assert command.setpoint_rate[env, joint] == pytest.approx(rate, abs=1e-12)


def test_feedforward_cancels_friction_in_the_direction_of_motion():
    friction, band, turns = np.array([0.5, 0.3]), np.array([0.1, 0.2]), np.array([0, 0.5 / math.pi])
    control = NEUTRAL._replace(modelled=friction, band=band, turns=turns)
    control = control._replace(powered=np.array([1.0, 0.0]))
    values = at(command=Command(rows(), rows(), rows(), rows()))
    forward = run(control, "feedforward", values)[1].forward
    for env, joint in entries():
        error = values.command.setpoint[env, joint] - values.seen.qpos[env, joint]
        if joint == 1:  # continuous
            error = math.remainder(error, 2 * math.pi)
        ahead = error + LOOKAHEAD * values.command.setpoint_rate[env, joint]
        share = min(max(ahead / band[joint], -1.0), 1.0)
        given = values.command.feedforward[env, joint]
        if joint == 0:  # the other has no motor
            given += values.seen.passive[env, joint]
        assert forward[env, joint] == pytest.approx(given + share * friction[joint], abs=1e-12)


def test_a_commanded_effort_is_limited_by_params_and_motors():
    control = NEUTRAL._replace(mode="effort")
    values = at(forward=rows(), limits=(np.full((N, DOF), -1.0), np.full((N, DOF), 2.0)))
    outputs = run(control, "saturation", values)[1].outputs
    for env, joint in entries():
        total = values.command.setpoint[env, joint] + values.forward[env, joint]
        effort = min(max(total, -1.0), 2.0)
        assert outputs.qf[env, joint] == outputs.motor[env, joint] == effort
        assert outputs.saturated[env, joint] == (effort != total)


def test_limits_are_narrowed_from_both_sides():
    values = at(limits=(None, np.full((N, DOF), 1.0))).within(rows(), np.full((N, DOF), 3.0))
    assert (values.limits[1] == 1.0).all()
    assert values.limits[0].shape == (N, DOF)


def test_targets_of_drives_are_next_to_the_joint():
    control = NEUTRAL._replace(mode="drive", params=PARAMS.replace(ki=None))
    control = control._replace(turns=np.array([0.0, 0.5 / math.pi]))
    values = at(command=Command(10 * rows(), rows(), None, None), forward=rows())
    outputs = run(control, "law", values)[1].outputs
    for env, joint in entries():
        target = values.command.setpoint[env, joint]
        if joint == 1:
            qpos = values.seen.qpos[env, joint]
            target = qpos + math.remainder(target - qpos, 2 * math.pi)
        assert outputs.target[env, joint] == pytest.approx(target, abs=1e-12)
    assert outputs.qf is values.forward


def test_the_mass_matrix_is_that_half_way_through_the_steps_that_it_serves():
    """The matrix of this model is the pose itself."""
    params = bp.make_params(DOF, kp=5.0, gain_units="mass_matrix")
    control = NEUTRAL._replace(params=params, armature=np.full(DOF, 0.5), damping=np.ones(DOF))
    stage = next(one for one in stages_of(control) if one.name == "matrix")
    model = Model(mass_matrix=lambda qpos: qpos[:, :, None] * np.eye(DOF))
    state, _ = stage.init(at())
    for index in range(10):
        values = at(index, model=model)
        state, _ = stage.step(state, values)
        if index in (0, 4, 8):
            ahead = (min(4, 10 - index) - 1) / 2 * DT
            first = values.seen.qpos + ahead * values.seen.qvel + 0.5 + DT
        for env, joint in entries():
            assert state[env, joint, joint] == pytest.approx(first[env, joint], abs=1e-12)


def test_other_units_of_the_gains_start_the_law_again():
    other = NEUTRAL.params.replace(gain_units="mass_matrix")
    stages = [
        next(one for one in stages_of(NEUTRAL._replace(params=params)) if one.name == "law")
        for params in (NEUTRAL.params, NEUTRAL.params.replace(kp=9.0), other)
    ]
    state, _ = stages[0].init(at())
    moved = state._replace(integral=state.integral + 3.0)
    assert stages[1].adopt(stages[0], moved, at()) is moved
    assert (stages[2].adopt(stages[0], moved, at()).integral == state.integral).all()


def test_the_inertia_of_friction_is_renewed_by_the_age_of_each_env():
    calls = []
    model = Model(
        joint_mass_matrix=lambda qpos: calls.append(1) or np.eye(DOF) + 0.0 * qpos[:, :, None],
        load=lambda: np.zeros((N, DOF)),
    )
    control = NEUTRAL._replace(friction=Friction(coulomb=np.full((1, DOF), 0.2)))
    stage = next(one for one in stages_of(control) if one.name == "inertia")
    state, _ = stage.init(at(model=model))
    state = state._replace(age=np.array([0, 10, 20]))
    ages, expected = [0, 10, 20], 1
    for _ in range(2 * REFRESH_STEPS):
        state, _ = stage.step(state, at(model=model))
        expected += REFRESH_STEPS in ages
        ages = [1 if age == REFRESH_STEPS else age + 1 for age in ages]
        assert state.age.tolist() == ages
    assert len(calls) == expected
    # Friction that has changed in one env renews its inertia alone.
    drawn = control._replace(friction=Friction(coulomb=np.array([[0.2, 0.2], [0.2, 0.3]])))
    other = next(one for one in stages_of(drawn) if one.name == "inertia")
    part = type(state)(*(rows[:2] for rows in state))
    assert other.adopt(stage, part, at(model=model)).age.tolist() == [ages[0], REFRESH_STEPS]


def test_a_late_sensor_shows_a_law_the_state_from_which_it_starts():
    """Its history begins at the present velocity, and the law at the shown position."""
    actuators = bp.make_actuators(DOF, sensor_delay=2 * DT, position_offset=0.1)
    control = NEUTRAL._replace(actuators=actuators)
    values = at(model=Model(envs=np.arange(N)), forward=rows())
    stages = stages_of(control)
    states = started(stages, values)
    _, after = stepped(stages, states, values)
    np.testing.assert_allclose(after.seen.qpos, values.measured.qpos + 0.1, atol=1e-12)
    np.testing.assert_array_equal(after.seen.qvel, values.measured.qvel)
    assert by_name(stages, states).keys() >= {"sensors", "law", "friction"}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_delay_of_whole_steps_is_one_but_for_rounding(dtype):
    """Written in seconds it is no whole number of steps in binary; a longer one is interpolated."""
    for steps in range(40):
        seconds = np.full((1, 1), round(steps * DT, 7), dtype)
        whole, fraction = delay.discretise(seconds, dtype(DT), 64)
        assert (whole.ravel().tolist(), fraction) == ([steps], None)
        assert delay.samples_of(seconds, DT) == steps + 2
        whole, fraction = delay.discretise(seconds + dtype(1e-4 * DT), dtype(DT), 64)
        assert whole[0, 0] == steps
        assert fraction[0, 0] == pytest.approx(1e-4, rel=0.2)
