"""Hooks of mkdocs: pages from the root of the repository, and names in docstrings.

Docstrings carry Sphinx roles such as ``:class:`Runner```, which mkdocstrings leaves as they are.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

OUTSIDE = ("SECURITY.md",)
"""Pages of the site in the root of the repository, where GitHub and other hosts look for them."""
_LINK = re.compile(rf"\]\(((?:\.\./)*)\.\./({'|'.join(map(re.escape, OUTSIDE))})")
_ROLE = re.compile(r":(?:attr|class|data|exc|func|meth|mod):<code>[~!]?([^<]+)</code>")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages in OUTSIDE to the files of the site."""
    for name in OUTSIDE:
        files.append(
            File.generated(config, name, abs_src_path=str(Path(__file__).parents[1] / name))
        )
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return the page with links to and from the pages in OUTSIDE rewritten for the site, whose
    root is docs/.
    """
    return (
        markdown.replace("](docs/", "](")
        if page.file.src_uri in OUTSIDE
        else _LINK.sub(r"](\1\2", markdown)
    )


def on_page_content(html: str, **_: Any) -> str:
    """Return the page with the names of roles as plain code."""
    return _ROLE.sub(r"<code>\1</code>", html)
