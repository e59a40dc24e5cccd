"""The PID law: params, state, coefficients and one pure step; gains of accelerations with a robot's
mass matrix.
"""

from batchpid.law.coefficients import as_explicit
from batchpid.law.computed_torque import advance_with_mass_matrix, check_gain_units

__all__ = ["advance_with_mass_matrix", "as_explicit", "check_gain_units"]
