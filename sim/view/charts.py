"""Charts of one joint: position and setpoint, error, effort and its limits."""

from __future__ import annotations

from typing import Any

import numpy as np

from batchpid.arrays.array_types import Document
from batchpid.sim.view.data import ViewData
from batchpid.sim.view.playback import HISTORY_SECONDS

_COLOURS = ("#15803d", "#d97706")
"""Colour of each group's curves."""
_LIMIT_RATIO = 4.0
"""A limit is drawn where it is less than this many times the largest effort."""
_MIN_RANGE = {"min": -0.012, "max": 0.012}
"""Smallest range of a vertical axis [rad, m, N m or N]: noise alone should not fill a chart."""
_SCALES = {
    "x": {"time": False, "range": (-HISTORY_SECONDS, 0.0)},  # without a fixed range the axis drifts in viser 1.1
    "y": {"range": {end: {"pad": 0.1, "soft": soft, "mode": 1} for end, soft in _MIN_RANGE.items()}},
}


class Charts:
    """Three charts in ``gui``, of one joint of the same robot in every group."""

    def __init__(self, gui: Any, data: ViewData) -> None:
        self._data = data
        names = data.groups if len(data.groups) > 1 else ("",)

        def chart(title: str, *series: Document) -> Any:
            return gui.add_uplot(
                (np.array([-HISTORY_SECONDS, 0.0]), *[np.zeros(2)] * len(series)),  # flat until the first update
                ({"label": "s"}, *series),
                title=title,
                scales=_SCALES,
                legend={"show": True, "live": False},
                height=168,
                axes=({"size": 30, "stroke": "#6b7280"}, {"size": 56, "stroke": "#6b7280"}),
                padding=(4, 14, 0, 0),
            )

        def curves(quantity: str) -> list[Document]:
            return [
                {"label": f"{quantity} {name}".strip(), "stroke": colour, "width": 2}
                for name, colour in zip(names, _COLOURS, strict=False)
            ]

        dashed = {"width": 1, "dash": [6, 4]}
        limits = ({"label": f"{end} limit", "stroke": "#b6bcc6", **dashed} for end in ("lower", "upper"))
        self._sets_positions = data.frame().info.sets_positions
        target = [{"label": "setpoint", "stroke": "#4a82ff", **dashed}] if self._sets_positions else []
        self._position = chart("position", *curves("qpos"), *target)
        self._error = chart("error", *curves("error"))
        self._error.visible = self._sets_positions
        self._effort = chart("effort", *limits, *curves("effort"))

    def update(self, env: int, joint: int) -> None:
        """Draw the recent past of a joint of robot ``env`` of every group."""
        data, history = self._data, self._data.history()
        if len(history.time) < 2:
            return
        past = history.time - history.time[-1]
        robots = env + data.per_group * np.arange(len(data.groups))
        arrays = (history.qpos, history.setpoint if self._sets_positions else history.qpos, history.effort)
        qpos, setpoint, effort = (array[:, robots, joint].T.astype(np.float64) for array in arrays)
        # A far limit would flatten the curve, and a gap (NaN) would empty the chart: such a limit repeats the curve.
        largest = np.abs(effort).max()
        limits = [
            np.full(len(past), limit) if abs(limit) < _LIMIT_RATIO * largest else effort[0]
            for limit in data.effort_limits(env, joint)
        ]
        described = data.robot.joints[joint]
        drawn = [*qpos, setpoint[0]] if self._sets_positions else qpos
        positions = np.round(drawn, 4)  # smaller differences make a flat line jitter
        for chart, title, curves in (
            (self._position, f"{described.name} [{described.unit}]", positions),
            (self._error, f"setpoint - qpos [{described.unit}]", setpoint - qpos),
            (self._effort, f"effort [{described.effort_unit}]", [*limits, *effort]),
        ):
            if chart.title != title:
                chart.title = title
            chart.data = (past, *curves)
