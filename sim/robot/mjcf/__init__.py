"""MJCF files: MuJoCo compiles them, and the model becomes the tables of a robot."""

# It imports MuJoCo, and says why that fails.
import batchpid.sim.geometry  # noqa: F401
