"""The page in a real browser: robots, sliders, a chart, playback."""

import io

import numpy as np
import pytest

from batchpid.sim import Runner
from batchpid.sim.view import LiveSimulation, Playback

pytestmark = pytest.mark.timeout(900)  # each wait for the page has a limit of its own


def picture(page):
    """Return a screenshot (height, width, 3)."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB")).astype(
        int
    )


def dark(image):
    """Count the pixels beside the panel that are as dark as the robots' links; the floor is
    brighter.
    """
    middle = image[:, : image.shape[1] - 360]
    return int((middle.max(-1) < 110).sum())


def number_box(page, label):
    """Return the number box of the slider with this label."""
    from selenium.webdriver.common.by import By

    return page.find_element(By.XPATH, f"//label[.='{label}']/following::input[@type='text'][1]")


def press(page, text):
    from selenium.webdriver.common.by import By

    page.find_element(By.XPATH, f"//*[normalize-space(text())='{text}']").click()


def enter(page, label, value):
    from selenium.webdriver.common.keys import Keys

    box = number_box(page, label)
    box.click()
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys(str(value), Keys.TAB)


def slide(page, label, steps):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    thumb = page.find_element(By.XPATH, f"//label[.='{label}']/following::*[@role='slider'][1]")
    for _ in range(steps):
        thumb.send_keys(Keys.ARROW_RIGHT)


@pytest.fixture
def live(panda):
    # Ten frames per second leave a busy machine time for the page.
    return LiveSimulation(panda, 2, workers=0, spread=0.0, physics="fast", period=0.1)


@pytest.fixture
def view(live, serve):
    view = serve(live)
    view.running = False  # a paused page answers at once
    return view


def test_robots_are_drawn_and_a_slider_moves_them(live, view, open_page, until):
    page = open_page(view.url)
    until(lambda: dark(picture(page)) > 500, what="drawing the robots")
    before, pose = picture(page), live.observation.qpos
    assert abs(pose[0, 0]) < 0.1
    enter(page, "panda_joint1 [rad]", 1.5)
    until(lambda: live.setpoint[0, 0] == 1.5, what="the number's setpoint")
    slide(page, "panda_joint1 [rad]", 5)
    until(lambda: live.setpoint[0, 0] == pytest.approx(1.505), what="the slider's setpoint")
    assert (live.setpoint[:, 0] == live.setpoint[0, 0]).all()
    press(page, "Run")
    until(lambda: live.observation.qpos[:, 0].min() > 1.0, what="the motion")
    until(
        lambda: (np.abs(picture(page) - before)[:, :-360].max(-1) > 40).sum() > 500,
        what="seeing the motion",
    )


def test_run_pause_and_reset(live, view, open_page, until):
    page = open_page(view.url)
    until(lambda: "diverged" in page.page_source, what="loading")
    press(page, "Run")
    until(lambda: live.time > 0.5, what="the run")
    press(page, "Pause")
    until(lambda: not view.running, what="the pause")
    press(page, "Reset")
    until(lambda: live.time == 0.0, what="the reset")
    np.testing.assert_allclose(live.observation.qpos, live.start, atol=1e-6)


def test_a_chart_draws_the_watched_joint(view, open_page, until):
    view.running = True
    page = open_page(view.url)

    def ink():
        panel = picture(page)[:, -330:]
        return (np.abs(panel - [21, 128, 61]).max(-1) < 30).sum() > 100

    until(ink, what="the curve")


@pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")
def test_a_recorded_run_plays(jaco2, serve, open_page, until):
    with Runner(jaco2, 2, params=jaco2.params(), workers=0, substeps=66) as runner:
        rollout = runner.rollout(np.broadcast_to(jaco2.target, (45, jaco2.dof)))
    playback = Playback(rollout, jaco2)
    page = open_page(serve(playback).url)
    until(lambda: dark(picture(page)) > 500, what="drawing the robots")
    until(lambda: playback.time > 0.5, what="playing")
