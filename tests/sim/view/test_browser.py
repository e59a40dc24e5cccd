"""The page as a person meets it, in a real browser: robots are there, sliders move them, charts draw."""

import io

import numpy as np
import pytest

from sim import Robot, Runner
from sim.view import Live, Playback


def picture(page):
    """The page as an array (height, width, 3)."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(page.get_screenshot_as_png())).convert("RGB")).astype(int)


def dark(image):
    """How many pixels between the panels are as dark as the robots' links, which the floor is not."""
    middle = image[:, 400 : image.shape[1] - 360]
    return int((middle.max(-1) < 110).sum())


def number_box(page, label):
    """The number box beside the slider of this label."""
    from selenium.webdriver.common.by import By

    return page.find_element(By.XPATH, f"//label[text()='{label}']/following::input[@type='text'][1]")


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

    thumb = page.find_element(By.XPATH, f"//label[text()='{label}']/following::*[@role='slider'][1]")
    for _ in range(steps):
        thumb.send_keys(Keys.ARROW_RIGHT)


@pytest.fixture
def live(serve):
    # Ten frames a second leave a busy machine time for the page.
    live = Live(Robot.load("panda"), 2, workers=0, spread=0.0, physics="fast", period=0.1)
    view = serve(live)
    view.panel.playing = False  # a page that stands still answers at once
    return live, view


def test_robots_are_there_and_a_slider_moves_them(live, open_page, until):
    live, view = live
    page = open_page(view.url)
    until(lambda: dark(picture(page)) > 500, what="drawing the robots")
    before, pose = picture(page), live.frame().qpos.copy()
    assert abs(pose[0, 0]) < 0.1
    enter(page, "joint1 [rad]", 1.5)
    until(lambda: live.setpoint[0, 0] == 1.5, what="the number's setpoint")
    slide(page, "joint1 [rad]", 5)
    until(lambda: live.setpoint[0, 0] == pytest.approx(1.55), what="the slider's setpoint")
    assert (live.setpoint[:, 0] == live.setpoint[0, 0]).all()
    press(page, "Run")
    until(lambda: live.frame().qpos[:, 0].min() > 1.0, what="the motion")
    until(
        lambda: (np.abs(picture(page) - before)[:, 400:-360].max(-1) > 40).sum() > 500,
        what="seeing the motion",
    )


def test_gains_pause_step_reset_and_push(live, open_page, until):
    live, view = live
    page = open_page(view.url)
    until(lambda: "no effort at its limit" in page.page_source, what="loading")
    press(page, "Step")
    until(lambda: live.time == pytest.approx(live.period), what="one step")
    press(page, "Gains")
    until(lambda: number_box(page, "kp").is_displayed(), what="the gains tab")
    enter(page, "kp", 77)
    until(lambda: 77.0 in live.gains["pid"]["kp"], what="the gain")
    press(page, "Disturb")
    until(lambda: number_box(page, "Payload [kg]").is_displayed(), what="the disturbance tab")
    enter(page, "Payload [kg]", 2)
    until(lambda: live.payload == 2.0, what="the payload")
    press(page, "+y")
    press(page, "Run")
    until(lambda: np.abs(live.frame().qpos - live.start).max() > 0.02, what="the push")
    assert 77.0 in np.asarray(live._runners[0].params.kp)
    press(page, "Pause")
    until(lambda: not view.panel.playing, what="the pause")
    press(page, "Reset")
    until(lambda: live.time == 0.0, what="the reset")
    np.testing.assert_allclose(live.frame().qpos, live.start, atol=1e-6)


def test_charts_draw_the_watched_joint(live, open_page, until):
    live, view = live
    live.go_to(live.robot.settings.target)
    view.panel.steps = 10
    page = open_page(view.url)
    until(lambda: "joint1 [rad]" in page.page_source, what="the chart's title")

    def ink():
        left = picture(page)[:, :380]
        return (np.abs(left - [21, 128, 61]).max(-1) < 30).sum() > 100

    until(ink, what="the curve")


def test_a_recorded_rollout_plays(serve, open_page, until):
    robot = Robot.load("jaco2")
    with Runner(robot, 2, workers=0, substeps=66) as runner:
        rollout = runner.rollout(np.broadcast_to(robot.settings.target, (45, robot.dof)))
    playback = Playback(robot, rollout)
    view = serve(playback, port=18090)
    page = open_page(view.url)
    until(lambda: dark(picture(page)) > 500, what="drawing the robots")
    until(lambda: playback.frame().time > 0.5, what="playing")
    view.panel.playing = False
    enter(page, "Time [s]", 0.1)
    until(lambda: playback.frame().time == pytest.approx(0.1, abs=playback.period), what="seeking")
