"""Frame rate of ``batchpid view``: frames served and drawn per second, and the real-time factor of the simulation.

    python bench/view.py --width 800 --height 600
    python bench/view.py panda --num-envs 8 --control pid drive --width 1440 --height 900 --picture view.png

Everything runs on this machine: workers, page server, and headless Chromium, which draws in software at the lowest
priority (nice 19). ``served`` counts the frames that the view sends, ``drawn`` those that the browser shows.
"""

from __future__ import annotations

import io
import shutil
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import psutil
import tyro
from PIL import Image
from selenium import webdriver

from batchpid.io.files import write_atomically
from batchpid.sim import Robot
from batchpid.sim.view import LiveSimulation, View

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
    """Options of the measurement."""

    robot: tyro.conf.Positional[str] = "jaco2"
    num_envs: int = 16
    control: tuple[Literal["pid", "drive"], ...] = ("pid",)
    physics: Literal["accurate", "fast"] = "fast"
    width: int = 1280
    height: int = 800
    seconds: float = 8.0
    loading: float = 8.0
    """Seconds until everything is loaded."""
    port: int = 18200
    picture: Path | None = None
    """Save a picture of the page 2 s after a step from the start pose to the target."""


def main(options: Options) -> None:
    """Serve a page, open it in a browser, and count frames once everything is loaded."""
    robot = Robot.load(options.robot)
    live = LiveSimulation(robot, options.num_envs, controls=options.control, physics=options.physics)
    target = robot.target if robot.settings is not None else robot.start
    live.set_setpoint(target)
    first = live.frame().qpos
    with View(live, port=options.port) as view, tempfile.TemporaryDirectory() as profile:
        thread = threading.Thread(target=view.run)
        thread.start()
        before = {process.pid for process in psutil.Process().children(recursive=True)}
        page = open_browser(options, profile)
        # Without fixedDpr viser lowers the resolution in a slow browser, which would spoil a picture.
        page.get(view.url if options.picture is None else f"{view.url}?fixedDpr=1")
        browser = [each for each in psutil.Process().children(recursive=True) if each.pid not in before]
        for process in browser:
            process.nice(19)
        time.sleep(options.loading)
        page.execute_script(COUNT)
        spent = _spent(browser)
        frames, simulated, began = live.time / live.period, live.time, time.monotonic()
        time.sleep(options.seconds)
        drawn = page.execute_script("return window.drawn")
        wall = time.monotonic() - began
        served, factor = (live.time / live.period - frames) / wall, (live.time - simulated) / wall
        spent = _spent(browser) - spent
        moved = np.abs(live.frame().qpos - first).max()
        if options.picture is not None:
            _picture(page, live, target, options.picture)
        page.quit()
        view.stop()
        thread.join()
        assert moved > 0.1, "the robots did not move"
    print(
        f"{options.num_envs} x {robot.name}, {' and '.join(options.control)}, {options.physics}, "
        f"{options.width} x {options.height}: "
        f"{served:.1f} frames/s served, {min(served, drawn / wall):.1f} drawn, {factor:.2f} x real time, "
        f"{1e3 * spent / max(1.0, min(served * wall, drawn)):.0f} ms of processor time in the browser per drawn frame"
    )


def open_browser(options: Options, profile: str) -> webdriver.Chrome:
    """Return headless Chromium with an empty page, and its profile in folder ``profile``."""
    chrome = webdriver.ChromeOptions()
    chrome.binary_location = shutil.which("chromium")
    for flag in (*FLAGS, f"--window-size={options.width},{options.height}", f"--user-data-dir={profile}"):
        chrome.add_argument(flag)
    return webdriver.Chrome(options=chrome, service=webdriver.ChromeService(shutil.which("chromedriver")))


def _spent(processes: list[psutil.Process]) -> float:
    """Return the processor time of ``processes`` [s]."""
    times = [process.cpu_times() for process in processes if process.is_running()]
    return sum(time.user + time.system for time in times)


def _picture(page: webdriver.Chrome, live: LiveSimulation, target: np.ndarray, path: Path) -> None:
    """Save a picture of the page 2 s after a step from the start pose to the target."""
    for toast in page.find_elements("css selector", ".mantine-Notification-closeButton"):
        toast.click()  # the notice that WebGL runs in software
    live.set_setpoint(live.robot.start)
    _until(live, 4.0)
    live.set_setpoint(target)
    _until(live, 2.0)
    with Image.open(io.BytesIO(page.get_screenshot_as_png())) as image:
        small = image.convert("RGB").quantize(256, kmeans=2, dither=Image.Dither.NONE)
    write_atomically(path, lambda file: small.save(file, "PNG", optimize=True))


def _until(live: LiveSimulation, seconds: float) -> None:
    end = live.time + seconds
    while live.time < end:
        time.sleep(0.02)


if __name__ == "__main__":
    main(tyro.cli(Options))
