"""Code blocks of the pages, and what makes them short."""

import importlib.util
import re
import shlex
from pathlib import Path

from tiny_urdf import joint, link, robot

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *ROOT.glob("docs/**/*.md")])
BLOCK = re.compile(
    r"(?:<!-- needs: (?P<needs>[\w., ]+) -->\n)?```(?P<language>\w*)\n(?P<code>.*?)```", re.DOTALL
)
SHORTER = {
    # command: flags that make it short
    "demo": ["--num-envs", "2", "--seconds", "0.1"],
    "rollout": ["--num-envs", "2", "--workers", "0", "--seconds", "0.1"],
    "excite": ["--seconds", "1"],
    "compare": ["--moves", "1", "--engine", "mujoco"],
    "view": ["--num-envs", "2", "--workers", "0", "--time-limit", "0.1", "--port", "8765"],
}
SHORTER_CODE = {
    # pattern in Python blocks: a smaller size
    r"\b64\b": "8",
    r"\b8(?=, robot\.dof\)|, params=params|, substeps=20\))": "2",
}
TWO_JOINTS = robot(*map(link, "abc"), joint("one", "a", "b"), joint("two", "b", "c"))


def blocks(page, *languages):
    return [match for match in BLOCK.finditer(page.read_text()) if match["language"] in languages]


def shell_lines(page):
    """Return the words of each command that can be run here: in shell blocks, and after "$ " in
    blocks that show what commands print.
    """
    code = "".join(match["code"] for match in blocks(page, "sh") if not missing(match))
    shown = "".join(match["code"] for match in blocks(page, "text"))
    code += "\n".join(re.findall(r"^\$ (.*)", shown, re.M))
    return [words for line in code.splitlines() if (words := shlex.split(line, comments=True))]


def missing(match):
    needed = re.findall(r"[\w.]+", match["needs"] or "")
    return [name for name in needed if importlib.util.find_spec(name) is None]
