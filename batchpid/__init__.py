"""Joint-level PID control for many robots at once: arrays in, arrays out."""
