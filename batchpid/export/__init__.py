"""Export of a tuned controller: files for other programs, each with the differences from the law of this package."""

from batchpid.export.c_header import to_c
from batchpid.export.exported import Exported

__all__ = ["Exported", "to_c"]
