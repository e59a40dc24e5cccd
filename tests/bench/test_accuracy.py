"""References of the engine's accuracy, and the errors that README and docs state."""

import numpy as np
import pytest
from robots import load_bundled
from scripts import load_script

from batchpid.errors import InvalidArgumentError

accuracy = load_script("accuracy")


@pytest.fixture(scope="module")
def panda():
    return load_bundled("panda")


def falling(robot, qpos, timestep, seconds):
    """Return the robot without effort, after ``seconds``."""
    plant = accuracy.EquationOfMotion(robot.dynamics(), np.zeros(robot.dof), qpos, timestep)
    for _ in range(round(seconds / timestep)):
        plant.step()
    return plant


def test_equation_of_motion_converges_with_the_fourth_order(panda):
    qpos = panda.sample(2, seed=3)
    fine = falling(panda, qpos, 1 / 16000, 0.05).read_qpos()
    coarse, finer = (np.abs(falling(panda, qpos, h, 0.05).read_qpos() - fine).max() for h in (1 / 200, 1 / 400))
    assert 1e-12 < finer < coarse / 10  # 16 in the limit


def test_equation_of_motion_keeps_the_energy(panda):
    """Kinetic energy is the work of gravity: the integral of -g(q) q'."""
    qpos, timestep = panda.sample(1, seed=3), 1 / 4000
    dynamics, still = panda.dynamics(), np.zeros((1, panda.dof))
    plant = accuracy.EquationOfMotion(dynamics, np.zeros(panda.dof), qpos, timestep)
    powers = []
    for _ in range(401):
        gravity = dynamics.inverse_dynamics(plant.read_qpos(), still, still)
        powers.append(-(gravity * plant.read_qvel()).sum())
        plant.step()
    # The state is one step ahead of the last power: bring that up to date, too.
    gravity = dynamics.inverse_dynamics(plant.read_qpos(), still, still)
    powers.append(-(gravity * plant.read_qvel()).sum())
    work = np.trapezoid(powers, dx=timestep)
    qvel = plant.read_qvel()[0]
    kinetic = qvel @ dynamics.mass_matrix(plant.read_qpos())[0] @ qvel / 2
    assert kinetic > 0.1
    assert kinetic == pytest.approx(work, rel=1e-5)


def test_passive_force_holds_still(panda):
    qpos = panda.sample(3, seed=1)
    plant = accuracy.EquationOfMotion(panda.dynamics(), panda.damping, qpos, 1 / 2000)
    for _ in range(100):
        plant.write_qf(plant.passive_force(True, True))
        plant.step()
    assert np.abs(plant.read_qpos() - qpos).max() < 1e-9


def test_contact_moves_begin_free_and_end_in_contact(panda):
    moves, dynamics = accuracy.contact_moves(panda, 4, seed=1), panda.dynamics()
    assert not dynamics.in_contact(moves.start).any()
    assert dynamics.in_contact(moves.target).all()


def test_limit_moves_leave_the_limits_of_one_joint(panda):
    moves = accuracy.limit_moves(panda, 4, seed=1)
    assert not panda.limit_violations(moves.start)
    assert [env for env, _, _ in panda.limit_violations(moves.target)] == [0, 1, 2, 3]
    assert not panda.dynamics().in_contact(moves.target).any()


@pytest.mark.slow
def test_free_motion_hardly_depends_on_the_solver(panda):
    errors = accuracy.measure_errors(panda, "free", count=1, seconds=0.1)
    accurate, *others = errors.values()
    assert len(others) >= 2
    for other in others:
        assert 0 < other.rms <= other.largest
        assert other.largest == pytest.approx(accurate.largest, rel=0.05)


def test_unknown_motion_is_refused(panda):
    with pytest.raises(InvalidArgumentError, match="motion"):
        accuracy.measure_errors(panda, "dance")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda", "jaco2"])
def test_errors_are_of_the_documented_order_of_magnitude(name):
    """The table of docs/performance.md, within a factor."""
    robot = load_bundled(name)
    bounds = {  # motion: (max, RMS) [rad]
        "free": (5e-2, 5e-3),
        "contact": (1.0, 5e-2),
        "limit": (2e-2, 1e-3),
    }
    errors = {motion: accuracy.measure_errors(robot, motion, count=2) for motion in bounds}
    for motion, (largest, rms) in bounds.items():
        for case, error in errors[motion].items():
            assert 1e-6 < error.rms < rms, (motion, case)
            assert error.largest < largest, (motion, case)
    fast, accurate = (errors["free"][physics, "equation of motion"].rms for physics in ("fast", "accurate"))
    assert fast == pytest.approx(accurate, rel=0.1)
