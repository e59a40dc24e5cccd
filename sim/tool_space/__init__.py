"""Poses of a tool as setpoints: by operational-space control, or by inverse kinematics and joint control."""
