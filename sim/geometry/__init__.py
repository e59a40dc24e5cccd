"""Geometry of shapes: hulls, masses, distances, mesh files and drawn surfaces.

MuJoCo and trimesh are tools here, as NumPy is. MuJoCo is imported here first, so that one place says
why that fails.
"""

from __future__ import annotations

import os

from batchpid.errors import BatchPIDError
from batchpid.io.files import imported

try:
    imported("mujoco")
except Exception as error:
    # MuJoCo loads the library that this variable names, although nothing is drawn here.
    if (library := os.environ.get("MUJOCO_GL")) is None:
        raise
    problem = f"MuJoCo cannot be imported with MUJOCO_GL={library!r}: {error}"
    raise BatchPIDError(f"{problem}; unset MUJOCO_GL, or install that library") from None
