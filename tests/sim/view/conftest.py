"""Fixtures: a served page and a headless browser."""

import shutil
import threading
import time

import pytest

FLAGS = [  # every pixel is drawn by the processor
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
    "--hide-scrollbars",
    "--window-size=1100,760",
]


@pytest.fixture
def serve():
    """Return a function that serves data in a thread until the end of the test."""
    pytest.importorskip("viser")
    from batchpid.sim.view import View

    running = []

    def serve(data):
        view = View(data, port=0)
        thread = threading.Thread(target=view.run)
        thread.start()
        running.append((view, thread))
        return view

    yield serve
    for view, thread in running:
        view.stop()
        thread.join()
        view.close()


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """Headless Chromium that draws in software; tests skip where it is not installed."""
    webdriver = pytest.importorskip("selenium.webdriver")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip(
            "needs Chromium and chromedriver (Debian: apt-get install chromium chromium-driver)"
        )
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    page = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    page.set_page_load_timeout(120)
    yield page
    page.quit()


@pytest.fixture
def open_page(browser):
    """Return a function that opens a page until the end of the test."""

    def open_page(url):
        browser.get(url)
        return browser

    yield open_page
    browser.get("about:blank")


@pytest.fixture
def until():
    """Return a function that waits for a condition and returns its value."""

    def until(condition, seconds=200, what="the condition"):
        deadline, pause = time.monotonic() + seconds, 0.05
        while time.monotonic() < deadline:
            if value := condition():
                return value
            time.sleep(pause)
            pause = min(0.5, 1.5 * pause)  # each check takes time from the page
        raise AssertionError(f"{what} did not happen within {seconds} s")

    return until
