"""How many frames a second a page of ``batchpid view`` gets, and draws, while the simulation keeps real time.

    python bench/view.py --width 800 --height 600

Everything runs on this machine: workers, page server, and headless Chromium drawing in software, which is put behind
the others (nice 19). ``served`` is what the view sends, ``drawn`` what the browser shows.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
import psutil
import tyro
from selenium import webdriver

from sim import Robot
from sim.view import Live, View

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--ignore-gpu-blocklist",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",  # else the whole page would go through the software GPU too
)
COUNT = "window.drawn = 0; const tick = () => { window.drawn++; requestAnimationFrame(tick) }; tick()"


@dataclass(frozen=True)
class Options:
    """What to measure."""

    robot: str = "jaco2"
    num_envs: int = 16
    physics: Literal["accurate", "fast"] = "fast"
    width: int = 800
    height: int = 600
    seconds: float = 8.0


def main(options: Options) -> None:
    """Serve, open, wait until all is loaded, count."""
    robot = Robot.load(options.robot)
    live = Live(robot, options.num_envs, physics=options.physics)
    live.go_to(robot.settings.target if robot.settings is not None else robot.start)
    first = live.frame().qpos
    with View(live, port=18200) as view, tempfile.TemporaryDirectory() as profile:
        thread = threading.Thread(target=view.run)
        thread.start()
        before = {process.pid for process in psutil.Process().children(recursive=True)}
        chrome = webdriver.ChromeOptions()
        chrome.binary_location = shutil.which("chromium")
        for flag in (*FLAGS, f"--window-size={options.width},{options.height}", f"--user-data-dir={profile}"):
            chrome.add_argument(flag)
        page = webdriver.Chrome(options=chrome, service=webdriver.ChromeService(shutil.which("chromedriver")))
        page.get(view.url)
        for process in psutil.Process().children(recursive=True):
            if process.pid not in before:
                process.nice(19)
        time.sleep(8)
        page.execute_script(COUNT)
        frames, simulated, began = live.time / live.period, live.time, time.monotonic()
        time.sleep(options.seconds)
        drawn = page.execute_script("return window.drawn")
        wall = time.monotonic() - began
        served, factor = (live.time / live.period - frames) / wall, (live.time - simulated) / wall
        page.quit()
        view.stop()
        thread.join()
        assert np.abs(live.frame().qpos - first).max() > 0.1, "the robots did not move"
    print(
        f"{options.num_envs} x {robot.name}, {options.physics}, {options.width} x {options.height}: "
        f"{served:.1f} frames/s served, {drawn / wall:.1f} drawn, {factor:.2f} x real time"
    )


if __name__ == "__main__":
    main(tyro.cli(Options))
