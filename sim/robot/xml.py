"""Safe reading of XML from untrusted sources: no entities, no DTD, no network, no oversized trees.

lxml's own options do it: they cover what ``defusedxml`` checks, whose lxml module is deprecated, and libxml2 limits
nesting and the size of text, which the standard library's parser does not.
"""

from __future__ import annotations

import math
from pathlib import Path

from lxml import etree

from batchpid.errors import RobotError


def parse_xml(path: Path) -> etree._Element:
    """Return the root element of the file at ``path``, without comments.

    Raises
    ------
    RobotError
        The file cannot be read, is not well-formed, or has a DTD.
    """
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
    """Return an attribute as a number, NaN and infinity included; ``where`` is for the RobotError if it is none."""
    text = element.get(key)
    try:
        return default if text is None else float(text)
    except ValueError:
        raise RobotError(f"{where}: <{element.tag} {key}={text!r}> is not a number; correct the URDF") from None


def numbers(element: etree._Element | None, key: str, default: str, where: str) -> tuple[float, ...]:
    """Return the finite numbers in an attribute, as many as there are in ``default``, which replaces a missing one."""
    text, count = default if element is None else element.get(key, default), len(default.split())
    try:
        values = tuple(float(word) for word in text.split())
    except ValueError:
        values = ()
    if element is not None and (len(values) != count or not all(map(math.isfinite, values))):
        need = "one finite number" if count == 1 else f"{count} finite numbers"
        raise RobotError(f"{where}: <{element.tag} {key}={text!r}> needs {need}; correct the URDF")
    return values
