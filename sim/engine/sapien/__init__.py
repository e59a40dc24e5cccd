"""SAPIEN: packs of scenes, dynamics, contacts. No other room imports SAPIEN, except to draw
pictures.
"""

from batchpid.sim.engine.native.library import import_sapien

import_sapien()  # before the modules of this room import it, with its warnings
