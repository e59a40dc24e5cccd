"""Hook of mkdocs: docstrings carry Sphinx roles such as ``:class:`Runner```, which mkdocstrings leaves as they are."""

from __future__ import annotations

import re
from typing import Any

_ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod):<code>[~!]?([^<]+)</code>")


def on_page_content(html: str, **_: Any) -> str:
    """Return the page with the names of roles as plain code."""
    return _ROLE.sub(r"<code>\1</code>", html)
