r"""Coulomb friction with stiction, and viscous damping: pure functions on (envs, joints), or any
other leading axes, for NumPy and JAX.

With the motor's effort tau, the load h (gravity and more), the mass matrix M, viscous damping B and
Coulomb friction F, a joint moves by M dv/dt = tau - h - B v - f, with f = F sgn(v) while it moves
and any |f| <= F that holds it at rest. In steps of dt both are taken at the end of the step
(backward Euler), which is stable at any ratio of B dt and F dt to the inertia (R. Kikuuwe et al.,
"Fixed-step friction simulation: from classical Coulomb model to modern continuous models", IROS
2005)::

    M (v+ - v) = dt (tau - h - B v+ - f),      f in F Sgn(v+)

- Viscous: (M + dt B) (v+ - v) = dt (tau - h - f - B v). The simulator adds the armature dt B to its
  joints, and -B v is part of the effort: exact for the whole robot, without its mass matrix.
- Coulomb: u = tau - f is the effort in [tau - F, tau + F] that brings v+ nearest to 0. With u' and
  v' of the step before, the load as it was then, and the share w of a change of velocity that
  damping leaves, the velocity under an unchanged u' is predicted as v + w (v - v'), and::

    u = min(max(u' - K (v + w (v - v')), tau - F), tau + F)             K = J / dt,  w = 1 - dt B / J

  J = 1 / ((M + dt B)^-1)_jj is the inertia that the joint shows. At rest u becomes the load h, for
  any tau within F of it, and the joint stays. In velocities integrated over time K is a spring of
  stiffness K / dt that yields at F: elastic, then plastic, so that a load below F never makes it
  creep, unlike LuGre's (P. Dupont, V. Hayward, B. Armstrong and F. Altpeter, "Single state
  elastoplastic friction models", IEEE Transactions on Automatic Control 47, 2002). The yield by
  clipping is the return mapping of J. C. Simo and T. J. R. Hughes, Computational Inelasticity
  (1998), section 1.4.

With a static friction F_s > F the bound is F_s until the joint yields. While it slides, the bound
falls with the speed from F_s to F. It is half way at the Stribeck velocity v_s; if v_s is 0, it is
F at once (D. P. Hess and A. Soom, "Friction at a lubricated line contact operating at oscillating
sliding velocities", Journal of Tribology 112, 1990). In gears friction grows with the transmitted
effort, here the effort of the motor::

    bound = F + (F_s - F) / (1 + (v / v_s)^2) + mu |tau|

With K = J / dt one joint stops in one step (deadbeat), and up to 4/3 of that is stable. Coupled
joints share it: with the correlations C_ij = A_ij / sqrt(A_ii A_jj) of A = (M + dt B)^-1, J_j = 1 /
(A_jj sum_i |C_ij|) keeps the eigenvalues of A J within [0, 1], by Gershgorin's theorem.
DEADBEAT_SHARE of K leaves room for inertias that change between two refreshes.
"""

from __future__ import annotations

from typing import NamedTuple

from batchpid.arrays.array_types import Array
from batchpid.arrays.elementwise import clip, namespace, tiny_of
from batchpid.checks import check_time_step

DEADBEAT_SHARE = 0.7
"""Share of the deadbeat gain K that is used."""
LOOKAHEAD = 0.1
"""Time ahead at which the setpoint is taken to determine the direction of motion [s]."""


class Friction(NamedTuple):
    """Friction and damping of joints, (envs, joints) or (1, joints); None for none."""

    coulomb: Array = None
    """F >= 0 [N m or N]."""
    viscous: Array = None
    """B >= 0 [N m s/rad or N s/m]."""
    static: Array = None
    """F_s >= F, friction of a joint at rest; 0: F [N m or N]."""
    stribeck: Array = None
    """v_s >= 0 [rad/s or m/s]."""
    load: Array = None
    """mu, from 0 to 1."""

    @property
    def most(self) -> Array:
        """Array that is positive for joints with friction other than viscous; None without such
        joints.
        """
        parts = [leaf for leaf in (self.coulomb, self.static, self.load) if leaf is not None]
        if parts:
            return sum(parts[1:], parts[0])
        return None


class FrictionState(NamedTuple):
    """State of the model, arrays (envs, joints); None where there is no Coulomb friction."""

    effort: Array = None
    """u of the last step, motor and Coulomb friction [N m or N]."""
    velocity: Array = None
    """v of the last step [rad/s or m/s]."""
    gain: Array = None
    """K (1 + w - dt^2 k / J), with the stiffness k of an implicit drive; the factor of v [N m s/rad
    or N s/m].
    """
    memory: Array = None
    """K w: the factor of v' [N m s/rad or N s/m]."""
    sliding: Array = None
    """1.0 if the joint was sliding in the last step, else 0.0."""


def init(
    friction: Friction,
    velocity: Array,
    load: Array,
    mass_matrix: Array,
    dt: float,
    damping: Array = 0.0,
    stiffness: Array = 0.0,
) -> FrictionState:
    """Return the state of joints that move at ``velocity`` (envs, joints), without Coulomb friction
    so far.

    Parameters
    ----------
    load
        Effort that holds the joints, h (envs, joints) [N m or N]; an estimate is as good, but for
        the first step.
    mass_matrix, dt, damping, stiffness
        As in :func:`refresh`.
    """
    check_time_step(dt)
    if friction.coulomb is None:
        return FrictionState()
    return with_sliding(
        friction,
        refresh(
            friction,
            started(velocity, load),
            mass_matrix,
            dt,
            damping,
            stiffness,
        ),
    )


def started(velocity: Array, load: Array) -> FrictionState:
    """Return the state of :func:`init` before :func:`refresh` sets K and w, and
    :func:`with_sliding` the sliding.
    """
    zero = namespace(velocity, load).zeros_like(velocity)
    return FrictionState(load + zero, velocity + zero, zero, zero, zero)


def with_sliding(friction: Friction, state: FrictionState) -> FrictionState:
    """Return the state of joints at rest or in motion: a joint slides where friction at rest is
    less than K |v|.
    """
    if friction.static is None:
        return state
    needed = abs((state.gain - state.memory) * state.velocity)
    slides = needed > bound_of(friction, state.sliding, state.effort, state.velocity)
    return state._replace(sliding=slides.astype(state.effort.dtype))


def refresh(
    friction: Friction,
    state: FrictionState,
    mass_matrix: Array,
    dt: float,
    damping: Array = 0.0,
    stiffness: Array = 0.0,
) -> FrictionState:
    """Return ``state`` with K and w at ``mass_matrix`` (envs, joints, joints) [kg m^2 or kg].

    ``damping`` and ``stiffness`` (envs, joints) or (1, joints) belong to a drive that the simulator
    integrates implicitly [N m s/rad, N m/rad].
    """
    check_time_step(dt)
    if friction.coulomb is None:
        return state
    xp = namespace(mass_matrix, *friction, *state)
    rubs = xp.zeros_like(state.effort) + friction.most > 0
    implicit = (0.0 if friction.viscous is None else friction.viscous) + damping + dt * stiffness
    implicit = xp.zeros_like(state.effort) + implicit
    eye = xp.broadcast_to(xp.eye(implicit.shape[-1], dtype=implicit.dtype), mass_matrix.shape)
    diagonal = implicit[..., None] * eye
    inverse = xp.linalg.inv(mass_matrix + dt * diagonal)
    # The diagonal is what each joint shows while the others are free.
    mobility = xp.diagonal(inverse, axis1=-2, axis2=-1)
    scale = xp.sqrt(mobility)
    # Coupled joints share the gain, by Gershgorin: see above.
    correlation = xp.abs(inverse) / (scale[..., :, None] * scale[..., None, :])
    shared = (correlation * rubs.astype(correlation.dtype)[..., None, :]).sum(-1)
    k = xp.where(
        rubs,
        DEADBEAT_SHARE / (dt * mobility * xp.where(rubs, shared, 1.0)),
        0.0,
    )
    w = 1 - dt * implicit * mobility
    return state._replace(gain=k * (1 + w - dt**2 * stiffness * mobility), memory=k * w)


def advance(
    friction: Friction,
    state: FrictionState,
    effort: Array,
    velocity: Array,
) -> tuple[FrictionState, Array]:
    """Advance the model by one step; return the state and the effort to apply (envs, joints) [N m
    or N].

    The joints' armature has to be dt B. ``effort`` is the motors' effort at ``velocity``. Inputs
    are not modified.
    """
    total = effort
    if friction.coulomb is not None:
        xp = namespace(effort, velocity, *state)
        # The effort that would bring the joint to rest, clipped to what friction can give.
        held = state.effort - state.gain * velocity + state.memory * state.velocity
        bound = bound_of(friction, state.sliding, effort, velocity)
        total = xp.minimum(xp.maximum(held, effort - bound), effort + bound)
        if friction.static is not None:
            state = state._replace(sliding=(total != held).astype(total.dtype))
        state = state._replace(effort=total, velocity=velocity)
    if friction.viscous is not None:
        total = total - friction.viscous * velocity
    return state, total


def bound_of(
    friction: Friction,
    sliding: Array,
    effort: Array,
    velocity: Array,
) -> Array:
    """Return the largest friction other than viscous (envs, joints) [N m or N] under the motors'
    ``effort``.

    ``sliding`` is positive for joints that were sliding in the last step.
    """
    bound = friction.coulomb
    if friction.static is not None:
        xp = namespace(bound, friction.static, velocity)
        rest = xp.maximum(bound, friction.static)
        if friction.stribeck is not None:
            square = friction.stribeck * friction.stribeck
            both = xp.maximum(square + velocity * velocity, tiny_of(velocity.dtype))
            bound = bound + (rest - bound) * (square / both)
        bound = xp.where(sliding > 0, bound, rest)
    if friction.load is not None:
        bound = bound + friction.load * namespace(effort).abs(effort)
    return bound


def compensation(
    coulomb: Array,
    error: Array,
    rate: Array,
    band: Array,
) -> Array:
    """Return the feedforward that cancels friction on the way to r: F times (e + LOOKAHEAD r') /
    band in [-1, 1].

    It has the sign of the commanded motion, not of the velocity, so it cannot chatter: friction,
    which is at least as large and opposes the velocity, leaves no more than 0 in the direction of
    motion. A joint that is at rest within ``band`` of its setpoint stays there.

    Parameters
    ----------
    coulomb
        F, known (1 | envs, joints) [N m or N].
    error, rate
        e = r - q and r' (envs, joints) [rad or m, and per s]; a rate of None is 0.
    band
        Half width in which the sign is blurred (1 | envs, joints) [rad or m].
    """
    xp = namespace(coulomb, error, rate, band)
    ahead = error if rate is None else error + LOOKAHEAD * rate
    return clip(ahead * (coulomb / band), -coulomb, coulomb, xp)
