"""The sampled loop of the law and a chain of rigid bodies, exactly: one matrix for a time step."""

import numpy as np


def spectral_radius(mass, kp, ki, kd, dt, filter_time=0.0, damping=0.0):
    """Return the largest modulus (...) of the loop's eigenvalues: below 1 it is stable.

    The state is (q, q - q', I, d), and the effort u = -kp q + I + kd d with the derivative
    d = (tau d' - (q - q')) / (tau + dt). Gains broadcast to (..., joints). Where ki is 0 its pole
    at 1 is left out.
    """
    mass = np.asarray(mass, float)
    kp, ki, kd, tau, damping = (
        np.broadcast_to(column, mass.shape[:-1])[..., None] * np.eye(mass.shape[-1])
        for column in (kp, ki, kd, filter_time, damping)
    )
    one = np.broadcast_to(np.eye(mass.shape[-1]), mass.shape)
    zero, has_integral = 0 * mass, (ki > 0) * one
    inverse = one / (np.diagonal(tau, axis1=-2, axis2=-1)[..., None] + dt)
    rate = [zero, -inverse, zero, tau @ inverse]
    effort = [-kp, kd @ rate[1], has_integral, kd @ rate[3]]
    implicit = np.linalg.inv(mass + dt * damping)
    step = [dt**2 * implicit @ column for column in effort]
    step[1] = step[1] + implicit @ mass
    position = [step[0] + one, *step[1:]]
    rows = [position, step, [-dt * ki, zero, has_integral, zero], rate]
    return np.abs(np.linalg.eigvals(np.block(rows))).max(-1)
