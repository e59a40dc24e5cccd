"""Safe reading of XML from untrusted sources: no entities, no DTD, no network, no oversized trees,
no odd numbers.

The options of lxml suffice: they cover the checks of ``defusedxml``, whose lxml module is
deprecated. libxml2 also limits nesting and the size of text, unlike the parser of the standard
library.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from lxml import etree

from batchpid.errors import RobotError
from batchpid.sim.findings import Finding
from batchpid.sim.geometry.mesh_files import LARGEST_NUMBER, LFS_POINTER

XML_SIZE_LIMIT = 2**25  # bytes of a file; its tree takes about ten times as much memory
FAULTS = {"ERR_HYPHEN_IN_COMMENT", "NS_ERR_UNDEFINED_NAMESPACE"}
"""Errors that other readers accept: ``--`` in comments, and prefixes of namespaces that nobody
declared.
"""


def parse_xml(path: Path, repairs: list[Finding] | None = None) -> etree._Element:
    """Return the root element of the file at ``path``, without comments and processing
    instructions.

    A file that is almost XML is read by :func:`_lenient`, which appends a finding to ``repairs``.
    Raises RobotError if the file cannot be read, is larger than XML_SIZE_LIMIT, is not well-formed,
    or has a DTD.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(XML_SIZE_LIMIT + 1)
        # One byte more than allowed is read, and no more.
        if len(data) > XML_SIZE_LIMIT:
            raise RobotError(
                f"{path}: larger than {XML_SIZE_LIMIT >> 20} MiB; remove what the robot does not need"
            )
        if data.startswith(LFS_POINTER):
            raise RobotError(f"{path}: a git-lfs pointer instead of the file; run git lfs pull")
        root, _errors = _parse(data)
    except etree.XMLSyntaxError as error:
        try:
            root = _lenient(data)
        except etree.XMLSyntaxError:
            raise RobotError(
                f"{path}: not well-formed XML: {error.msg}; correct the file at that line"
            ) from error
        if repairs is not None:
            text = f"not well-formed XML: {error.msg}; read as far as possible"
            repairs.append(Finding("xml", text, "correct the file at that line"))
    except OSError as error:
        raise RobotError(
            f"{path}: cannot be read: {error}; check that it is a readable text file"
        ) from error
    if root.getroottree().docinfo.internalDTD is not None:
        raise RobotError(
            f"{path}: a DTD or entity declaration is refused for safety; remove the <!DOCTYPE>"
            " lines"
        )
    _drop_default_namespace(root)
    return root


def _drop_default_namespace(root: etree._Element) -> None:
    """Take elements out of a default namespace, which readers of robots ignore."""
    elements = [
        element
        for element in root.iter("{*}*")
        if element.prefix is None and element.tag.startswith("{")
    ]
    for element in elements:
        element.tag = etree.QName(element).localname
    if elements:
        etree.cleanup_namespaces(root)


def _parse(data: bytes, recover: bool = False) -> tuple[etree._Element, set[str]]:
    """Return the root element, and the types of the errors in spite of which it was read."""
    parser = etree.XMLParser(
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        remove_comments=True,
        remove_pis=True,
        recover=recover,
    )
    root = etree.fromstring(data, parser)
    return root, {error.type_name for error in parser.error_log}


def _lenient(data: bytes) -> etree._Element:
    """Return the first ``<robot>``, or other element, of a file with :data:`FAULTS`, or with a
    wrong encoding. Raises XMLSyntaxError for other faults.
    """
    utf16 = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        text = data.decode("utf-16" if utf16 else "utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    # An ampersand that begins no entity.
    text = re.sub(r"&(?!\w+;|#)", "&amp;", text)
    # The declaration may be in the wrong place, or name another encoding.
    text = re.sub(r"<\?xml [^>]*>", "", text)
    wrapper, errors = _parse(f"<file>{text}</file>".encode(errors="replace"), recover=True)
    root = wrapper.find("{*}robot")
    if root is None and len(wrapper):
        root = wrapper[0]
    if root is None or errors - FAULTS:
        raise etree.XMLSyntaxError("no element", 0, 0, 0)
    wrapper.remove(root)
    root.tail = None
    return root


def numbers(
    element: etree._Element | None,
    key: str,
    default: str,
    limit: bool = False,
) -> tuple[float, ...] | None:
    """Return the numbers in an attribute, as many as there are in ``default``, which replaces a
    missing or empty one; commas may stand between them.

    None unless they are finite and at most LARGEST_NUMBER in magnitude; a joint ``limit`` may be
    infinite.
    """
    text = ("" if element is None else element.get(key, "").strip()) or default
    count = len(default.split())
    # In other places a comma may be that of a decimal fraction.
    if len(text.split(",")) == count:
        text = text.replace(",", " ")
    try:
        values = tuple(map(float, text.split()))
    except ValueError:
        return None
    # Python alone reads 1_0 and digits of other scripts as numbers.
    if len(values) != count or "_" in text or not text.isascii():
        return None
    if all(abs(value) <= LARGEST_NUMBER or (limit and math.isinf(value)) for value in values):
        return values
    return None


def fault(element: etree._Element | None, key: str, default: str) -> str | None:
    """Return the reason for which :func:`numbers` is None, which quotes the attribute, or None."""
    if element is None or numbers(element, key, default) is not None:
        return None
    count = len(default.split())
    need = f"{count} finite number" + "s" * (count > 1)
    within = f"within +-{LARGEST_NUMBER:g}"
    return f"<{element.tag} {key}={element.get(key)!r}> needs {need} {within}"


def read_numbers(
    element: etree._Element | None,
    key: str,
    default: str,
    where: str,
) -> tuple[float, ...]:
    """Return :func:`numbers`, or raise a RobotError whose message begins with ``where``."""
    values = numbers(element, key, default)
    if values is None:
        raise RobotError(f"{where}: {fault(element, key, default)}; correct the URDF")
    return values
