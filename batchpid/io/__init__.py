"""Files of params, of actuators, and of arrays."""
