"""Export of a tuned controller: files for other programs, each with the differences from the law of this package."""

from batchpid.export.c_header import to_c
from batchpid.export.c_project import to_c_project
from batchpid.export.differences import Exported, Imported
from batchpid.export.ros2_control import to_ros2_control
from batchpid.export.ros2_control_reader import from_ros2_control
from batchpid.export.simulators import to_isaac_lab, to_maniskill, to_newton

__all__ = [
    "Exported",
    "Imported",
    "from_ros2_control",
    "to_c",
    "to_c_project",
    "to_isaac_lab",
    "to_maniskill",
    "to_newton",
    "to_ros2_control",
]
