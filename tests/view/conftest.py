"""A page with robots, and a headless browser to look at it."""

import shutil
import threading
import time

import pytest

FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-extensions",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--ignore-gpu-blocklist",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
]


@pytest.fixture
def serve():
    """Serve a source in a thread for as long as the test lasts."""
    pytest.importorskip("viser")
    from sim.view import View

    running = []

    def serve(source, port=18080):
        view = View(source, port=port)
        thread = threading.Thread(target=view.run)
        thread.start()
        running.append((view, thread))
        return view

    yield serve
    for view, thread in running:
        view.stop()
        thread.join()
        view.close()


@pytest.fixture
def open_page(tmp_path):
    """Open a page in headless Chromium, drawn in software; skipped where it is not installed."""
    webdriver = pytest.importorskip("selenium.webdriver")
    browser, driver = (
        shutil.which("chromium") or shutil.which("chromium-browser"),
        shutil.which("chromedriver"),
    )
    if browser is None or driver is None:
        pytest.skip("needs Chromium and chromedriver (Debian: apt-get install chromium chromium-driver)")
    pages = []

    def open_page(url, width=1280, height=800):
        options = webdriver.ChromeOptions()
        options.binary_location = browser
        for flag in (
            *FLAGS,
            f"--window-size={width},{height}",
            f"--user-data-dir={tmp_path / f'profile{len(pages)}'}",
        ):
            options.add_argument(flag)
        page = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
        pages.append(page)
        page.set_page_load_timeout(60)
        page.get(url)
        return page

    yield open_page
    for page in pages:
        page.quit()


@pytest.fixture
def until():
    """Wait until a condition holds, and return what it returned."""

    def until(condition, seconds=60, what="it"):
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if found := condition():
                return found
            time.sleep(0.1)
        raise AssertionError(f"{what} did not happen within {seconds} s")

    return until
