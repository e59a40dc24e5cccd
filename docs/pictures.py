"""Draw the pictures of the guides again: ``python docs/pictures.py``.

Those of the tutorial are made by its own programs.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from batchpid.sim import Robot
from batchpid.sim.view.film import Painter

DOCS = Path(__file__).resolve().parent


def tutorial(folder: Path) -> dict[str, Any]:
    """Run the tutorial's programs up to its pictures in ``folder``, and return their names."""
    text = (DOCS / "tutorial.md").read_text().partition("## 5.")[0]
    names: dict[str, Any] = {}
    before = Path.cwd()
    os.chdir(folder)
    try:
        for code in re.findall(r"```python\n(.*?)```", text, re.S):
            exec(code, names)
    finally:
        os.chdir(before)
    return names


def view() -> None:
    """Draw sixteen robots as films and the page show them."""
    robot = Robot.load("jaco2")
    poses = robot.target + 0.25 * (robot.sample(16, seed=0) - robot.target)
    picture = Painter(robot, 16, robot.has_ground, (1100, 560)).picture(poses)
    Image.fromarray(np.asarray(picture)).save(DOCS / "images/view-jaco2.png", optimize=True)


if __name__ == "__main__":
    with TemporaryDirectory() as folder:
        tutorial(Path(folder))
        for name in ("good", "bad"):
            shutil.copy(Path(folder, f"{name}.png"), DOCS / f"images/tutorial-{name}.png")
    view()
