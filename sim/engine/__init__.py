"""The gateway to SAPIEN's physics; no other room but the renderer imports SAPIEN."""
