"""Controls of the page, and the requests that they make.

viser calls back from a separate thread, with unchecked data of a page. A control keeps its last valid value; requests
are queued and carried out between two frames.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from functools import partial
from typing import Any

from batchpid.checks.validate import choice, flag, number
from batchpid.errors import BatchPIDError, InvalidArgumentError

MAX_REQUESTS = 256
"""Largest number of requests between two frames."""


class Requests:
    """Queue of requests from the pages. ``refuse`` is called with the reason for every request that fails."""

    def __init__(self, refuse: Callable[[str], object]) -> None:
        self.refuse = refuse
        self._queue: queue.Queue[Callable[[], object]] = queue.Queue(MAX_REQUESTS)

    def put(self, request: Callable[[], object]) -> None:
        """Queue a request. Safe to call from any thread."""
        try:
            self._queue.put_nowait(request)
        except queue.Full:
            self.refuse(f"more than {MAX_REQUESTS} requests in a frame; slow down")

    def run(self) -> None:
        """Carry out the requests that are queued now."""
        for _ in range(self._queue.qsize()):
            try:
                self._queue.get_nowait()()
            except BatchPIDError as error:
                self.refuse(str(error))


class Control:
    """Slider, drop-down, checkbox or group of buttons: a ``handle`` of viser, and its last valid value."""

    def __init__(self, handle: Any, requests: Requests) -> None:
        self.handle = handle
        """Handle of viser, for everything but the value."""
        self._value, self._requests = handle.value, requests
        self._actions: list[Callable[[Any], object]] = []
        (handle.on_click if hasattr(handle, "on_click") else handle.on_update)(self._changed)

    @property
    def value(self) -> Any:
        """Last valid value. Setting it shows it on every page."""
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        self._value = self.handle.value = value

    def on_change(self, action: Callable[[Any], object]) -> Control:
        """Request ``action(value)`` whenever a page, and not this program, changes the control."""
        self._actions.append(action)
        return self

    def change(self, value: Any) -> None:
        """Set the value and carry out the actions, between two frames."""
        self.value = value
        for action in self._actions:
            action(value)

    async def _changed(self, event: Any) -> None:
        if event.client is None:
            return
        try:
            self._value = _checked(self.handle)
        except InvalidArgumentError as error:
            self._requests.refuse(str(error))
            self.handle.value = self._value
            return
        for action in self._actions:
            self._requests.put(partial(action, self._value))


def _checked(handle: Any) -> Any:
    """Return the value of a control if it is one that the control offers."""
    if hasattr(handle, "options"):
        return choice(handle.label, handle.value, handle.options)
    if hasattr(handle, "max"):
        return number(handle.label, handle.value, handle.min, handle.max, "as on the slider")
    return flag(handle.label, handle.value)
