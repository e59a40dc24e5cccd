"""Compare the weight of library, tests and bench, and the lines of C++, with the ceilings in
.ci/ceilings.

The weight of a file is the number of nodes of its syntax tree without docstrings and load and store
marks, plus one for 20 characters of its other strings. Layout, names and comments weigh nothing.
CONTRIBUTING.md says when a ceiling is raised.
"""

import ast
import subprocess
import sys
from collections import Counter
from pathlib import Path

FOLDERS = {"batchpid": "library", "sim": "library", "tests": "tests", "bench": "bench"}
MARKS = (ast.Load, ast.Store, ast.Del)
CPP = (".cpp", ".h", ".c")


def is_docstring(node: ast.AST) -> bool:
    """Return whether a statement is a string that stands alone."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def weigh(node: ast.AST) -> float:
    """Return the weight of a node and all below it."""
    if is_docstring(node) or isinstance(node, MARKS):
        return 0.0
    is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
    text = len(node.value) / 20 if is_text else 0.0
    return 1 + text + sum(map(weigh, ast.iter_child_nodes(node)))


def main() -> int:
    """Print what is above its ceiling, and where; return the exit status."""
    sys.setrecursionlimit(10_000)
    root = Path(__file__).resolve().parents[1]
    listing = subprocess.run(
        ["git", "ls-files"], cwd=root, capture_output=True, text=True, check=True
    ).stdout
    rooms: dict[str, Counter[str]] = {
        "library": Counter(),
        "tests": Counter(),
        "bench": Counter(),
        "C++": Counter(),
    }
    for name in listing.splitlines():
        path, folder = root / name, name.split("/")[0]
        if path.suffix == ".py" and folder in FOLDERS and path.is_file():
            rooms[FOLDERS[folder]]["/".join(name.split("/")[:-1])] += weigh(
                ast.parse(path.read_text())
            )
        elif path.suffix in CPP and path.is_file():
            rooms["C++"][name] += path.read_text().count("\n")
    status = 0
    for line in (root / ".ci" / "ceilings").read_text().splitlines():
        name, ceiling = line.rsplit(maxsplit=1)
        total, limit = round(sum(rooms[name].values())), int(ceiling)
        print(f"{name}: {total} of {limit}")
        if total > limit:
            heaviest = ", ".join(
                f"{room} {round(weight)}" for room, weight in rooms[name].most_common(8)
            )
            print(f"  above its ceiling by {total - limit}; the heaviest: {heaviest}")
            status = 1
        elif total < 0.99 * limit:
            print(f"  lower the ceiling in .ci/ceilings to {total}")
    return status


if __name__ == "__main__":
    sys.exit(main())
