"""Reading XML that may come from a stranger: no entities, no DTD, no network, no oversized trees."""

from __future__ import annotations

import math
from pathlib import Path

from lxml import etree

from batchpid.errors import RobotError, RobotNotFoundError


def parse_xml(path: Path) -> etree._Element:
    """Root element of the file at ``path``, without comments.

    Raises
    ------
    RobotNotFoundError
        There is no such file.
    RobotError
        It is not well-formed, or has a DTD.
    """
    if not path.is_file():
        raise RobotNotFoundError(f"no file at {path}; check the path")
    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, remove_comments=True)
    try:
        tree = etree.parse(str(path), parser)
    except etree.XMLSyntaxError as error:
        raise RobotError(f"{path}: not well-formed XML: {error.msg}; correct the file at that line") from error
    except OSError as error:
        raise RobotError(f"{path}: cannot be read: {error}; check that it is a readable text file") from error
    if tree.docinfo.internalDTD is not None:
        raise RobotError(f"{path}: a DTD or entity declaration is refused for safety; remove the <!DOCTYPE> lines")
    return tree.getroot()


def number(element: etree._Element, key: str, default: float, where: str) -> float:
    """Attribute ``key`` as a number, NaN and infinity included."""
    text = element.get(key)
    if text is None:
        return default
    try:
        return float(text)
    except ValueError:
        raise RobotError(f"{where}: <{element.tag} {key}={text!r}> is not a number; correct the URDF") from None


def numbers(element: etree._Element, key: str, count: int, where: str) -> list[float]:
    """Attribute ``key`` as ``count`` finite numbers."""
    text = element.get(key, "")
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        need = "one finite number" if count == 1 else "three numbers, all finite"
        raise RobotError(f"{where}: <{element.tag} {key}={text!r}> needs {need}; correct the URDF")
    return values
