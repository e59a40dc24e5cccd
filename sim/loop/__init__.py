"""The closed loop over the scenes of one process: read, compensate, control, write, step."""
