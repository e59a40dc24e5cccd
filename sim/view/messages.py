"""Messages that the page may send, as schemas; all others are not passed on to viser."""

from __future__ import annotations

from typing import Annotated

import msgspec

from batchpid.errors import InvalidArgumentError

MAX_BYTES = 4096
"""Largest message of the page; the page's largest, a camera, has about 400 bytes."""
_Number = Annotated[float, msgspec.Meta(ge=-1e300, le=1e300)]
"""Finite number."""
_Text = Annotated[str, msgspec.Meta(max_length=200)]
_Vector = tuple[_Number, _Number, _Number]


class _Message(msgspec.Struct, tag_field="type", forbid_unknown_fields=True):
    """Message of viser's page. Its class of the same name in viser has these fields."""


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    """Change of a control. viser would set any attribute of the control's state that a message names."""

    value: bool | _Number | _Text


class _GuiUpdateMessage(_Message, tag="GuiUpdateMessage"):
    """Control that was changed."""

    uuid: _Text
    updates: _Value


class _SceneNodeClickMessage(_Message, tag="SceneNodeClickMessage"):
    """Click on a robot."""

    name: _Text
    instance_index: int | None
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: tuple[_Number, _Number]
    modifier: _Text | None
    owner: _Text = ""


class _ViewerCameraMessage(_Message, tag="ViewerCameraMessage"):
    """Camera of the page; viser counts a page as connected after its first."""

    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    fov: _Number
    near: _Number
    far: _Number
    image_height: _Number
    image_width: _Number
    look_at: _Vector
    up_direction: _Vector


class _TransformControlsDragStartMessage(_Message, tag="TransformControlsDragStartMessage"):
    """Frame at the tool that the pointer takes."""

    name: _Text
    owner: _Text = ""


class _TransformControlsUpdateMessage(_Message, tag="TransformControlsUpdateMessage"):
    """Frame at the tool that was dragged."""

    name: _Text
    wxyz: tuple[_Number, _Number, _Number, _Number]
    position: _Vector
    owner: _Text = ""


class _TransformControlsDragEndMessage(_Message, tag="TransformControlsDragEndMessage"):
    """Frame at the tool that the pointer leaves."""

    name: _Text
    owner: _Text = ""


_DECODER = msgspec.msgpack.Decoder(
    _GuiUpdateMessage
    | _SceneNodeClickMessage
    | _ViewerCameraMessage
    | _TransformControlsDragStartMessage
    | _TransformControlsUpdateMessage
    | _TransformControlsDragEndMessage
)


def check_message(data: bytes | str) -> None:
    """Check that ``data`` is a message that the page may send.

    Raises
    ------
    InvalidArgumentError
        It is not.
    """
    try:
        if isinstance(data, str):
            raise ValueError("text instead of msgpack")
        _DECODER.decode(data)
    except (ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise InvalidArgumentError("message", f"was not accepted: {error}", remedy="reload the page") from None
