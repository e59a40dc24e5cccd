"""MJCF files: MuJoCo compiles them, and the model becomes the tables of a robot."""
