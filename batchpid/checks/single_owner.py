"""Base of objects that own processes, scenes or files, and so have no copies."""

from __future__ import annotations

from typing import Any, ClassVar

from batchpid.errors import NotCopyableError


class SingleOwner:
    """Base of objects that can be neither copied nor pickled: two would close each other's
    processes and files.
    """

    instead: ClassVar[str] = "make another one"
    """Alternative to a copy, for the error message."""

    def __reduce__(self) -> Any:
        """Refuse; copy.copy, copy.deepcopy and pickle call it.

        Raises
        ------
        NotCopyableError
            Always.
        """
        name = type(self).__name__
        raise NotCopyableError(
            f"a {name} can be neither copied nor pickled, since it owns processes, scenes or files;"
            f" {self.instead}"
        )
