"""Export of a tuned controller: files for other programs, each with the differences from the law of
this package.
"""

from batchpid.export.c_header import to_c
from batchpid.export.differences import Exported
from batchpid.export.ros2_control import to_ros2_control

__all__ = ["Exported", "to_c", "to_ros2_control"]
