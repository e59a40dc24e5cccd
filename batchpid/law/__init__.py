"""The PID law: params, state, coefficients and one pure step."""
