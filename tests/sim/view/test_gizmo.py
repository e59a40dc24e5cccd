"""Target of control "osc": set from Python, and dragged on a page."""

import asyncio

import numpy as np
import pytest

import batchpid.task_space as ts
from batchpid.errors import InvalidArgumentError
from batchpid.sim.view import LiveSimulation


@pytest.fixture
def live(panda):
    live = LiveSimulation(panda, 2, controls=("osc",), workers=0, spread=0.0, physics="fast", period=0.05)
    yield live
    live.close()


def errors(live):
    """Distances of the tools to their targets (envs,) [m]."""
    qpos = live.frame().qpos[0].astype(float)
    tools = ts.link_poses(live.robot.kinematic_tree(), qpos, ["panda_hand"])[:, 0]
    return np.linalg.norm(tools[:, :3] - live.setpoint[:, :3], axis=1)


def test_tools_go_to_their_targets(live):
    assert errors(live).max() < 1e-6
    live.set_target(np.add(live.neutral, [0.05, 0, -0.05, 0, 0, 0, 0]), env=1)
    assert (errors(live) > 0.05).tolist() == [False, True]
    for _ in range(20):
        live.advance()
    assert errors(live).max() < 1e-3
    frame = live.frame()
    assert frame.setpoint.shape == (1, 2, 7)
    assert not frame.info.sets_positions
    assert live.effort_limits(0, 2) == (-87.0, 87.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"controls": ("osc", "pid")}, "controls: take different setpoints"),
        ({"controls": ("osc",), "tool": "hand"}, "tool: unknown option"),
        ({"tool": "panda_hand"}, "tool: is for control 'osc'"),
    ],
)
def test_other_controls_have_no_tool(panda, options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        LiveSimulation(panda, 1, workers=0, **options)


def test_bad_targets_are_refused(live, panda):
    before = live.setpoint.copy()
    for pose, message in (
        ([0.5, 0, 0.5, 0, 0, 0, 0], "no orientation"),
        ([11.0, 0, 0, 1, 0, 0, 0], "out of reach"),
        ([np.nan, 0, 0, 1, 0, 0, 0], "pose, entry 'x'"),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            live.set_target(pose)
    np.testing.assert_array_equal(live.setpoint, before)
    joints = LiveSimulation(panda, 1, workers=0)
    with pytest.raises(InvalidArgumentError, match="set_setpoint"):
        joints.set_target(before[0])
    joints.close()


def test_a_dragged_frame_is_the_target_of_the_watched_robot(live, serve, monkeypatch):
    pytest.importorskip("viser")
    from tests.sim.view.test_gate import Page, until

    monkeypatch.setattr("batchpid.sim.view.page.NOTICE_SECONDS", 0.0)
    view = serve(live, port=18300)
    view.panel.frames_left = 0
    at = view._scene.layout.positions
    drag = {"type": "TransformControlsUpdateMessage", "name": "/target", "wxyz": (0.0, 2.0, 0.0, 0.0)}

    async def run():
        async with Page(view) as page:
            before = live.setpoint.copy()
            await page.send({"type": "TransformControlsDragStartMessage", "name": "/target"})
            await page.send({**drag, "position": tuple((at[0] + [0.4, 0.1, 0.5]).tolist())})
            await until(lambda: (live.setpoint[0] != before[0]).any())
            np.testing.assert_allclose(live.setpoint[0], [0.4, 0.1, 0.5, 0, 2, 0, 0], atol=1e-9)
            np.testing.assert_array_equal(live.setpoint[1], before[1])
            await page.send({"type": "TransformControlsDragEndMessage", "name": "/target"})

            frame = view._gizmo._frame
            for bad, notice in (({"position": (99.0, 0.0, 0.0)}, "out of reach"), ({"position": (0.0, "x", 0.0)}, "x")):
                await page.send({**drag, **bad})
                await until(lambda notice=notice: any(notice in each for each in page.notices))
            await until(lambda: np.allclose(frame.position, at[0] + [0.4, 0.1, 0.5]))  # it is back at the target

            await page.change("Watched robot only", False)
            await page.change("Robot", 1)
            await until(lambda: np.allclose(frame.position, at[1] + before[1, :3]))
            await page.send({**drag, "position": tuple((at[1] + [0.3, 0.1, 0.5]).tolist())})
            await until(lambda: live.setpoint[0, 0] < 0.35)
            np.testing.assert_allclose(live.setpoint[:, :3], [[0.3, 0.1, 0.5]] * 2, atol=1e-9)
            await page.change("Go to", "start")
            await until(lambda: np.allclose(live.setpoint, live.neutral))
            await until(lambda: np.allclose(frame.position, at[1] + live.neutral[:3]))

    asyncio.run(run())
