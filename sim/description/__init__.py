"""Robot descriptions: a URDF or MJCF file becomes rows of bodies, joints and shapes."""

# It imports MuJoCo, and says why that fails.
import batchpid.sim.geometry  # noqa: F401
