"""The charts of one joint: position and setpoint, error, effort within its limits."""

from __future__ import annotations

from typing import Any

import numpy as np

from .source import Source

_INK = {"setpoint": "#4a82ff", "limit": "#b6bcc6"}
_COLOURS = ("#15803d", "#d97706", "#7c3aed")
"""The first group's curve, the second's, ..."""
_FAR = 1e9
_NEAR = 4.0
"""A limit is drawn once it is less than so many times the effort."""
_LEAST = {"rad": 0.02, "m": 0.002}
"""An axis of positions covers so much at least, [rad] or [m]: what is smaller would be drawn as if it mattered."""
WINDOW = 8.0
"""How far back the time axis goes [s]: it counts from now."""


class Charts:
    """Three charts in a panel of ``gui``, of one joint of the same robot in every group."""

    def __init__(self, gui: Any, source: Source) -> None:
        self._source = source
        names = source.groups if len(source.groups) > 1 else ("",)
        still = np.array([-WINDOW, 0.0])

        def chart(title: str, series: list[dict[str, Any]]) -> Any:
            data = tuple(still for _ in range(len(series) + 1))
            return gui.add_uplot(
                data,
                ({"label": "s"}, *series),
                title=title,
                scales=_scales(0.0, 1.0),
                legend={"show": True, "live": False},
                height=168,
                axes=({"size": 30, "stroke": "#6b7280"}, {"size": 56, "stroke": "#6b7280"}),
                padding=(4, 14, 0, 0),
            )

        def lines(what: str) -> list[dict[str, Any]]:
            return [
                {"label": f"{what} {name}".strip(), "stroke": colour, "width": 2}
                for name, colour in zip(names, _COLOURS, strict=False)
            ]

        self._position = chart("position", [*lines("qpos"), _dashed("setpoint", _INK["setpoint"])])
        self._error = chart("error", lines("error"))
        self._effort = chart(
            "effort",
            [_dashed("lower limit", _INK["limit"]), _dashed("upper limit", _INK["limit"]), *lines("effort")],
        )

    def show(self, env: int, joint: int) -> None:
        """Draw the recent past of a joint of robot ``env`` of every group."""
        source = self._source
        robots = [group * source.per_group + env for group in range(len(source.groups))]
        traces = [source.traces(robot, joint) for robot in robots]
        time = traces[0].time
        if len(time) < 2:
            return
        recent = time >= time[-1] - WINDOW
        unit = source.robot.joints[joint].unit
        force = "N" if unit == "m" else "N m"
        name = source.robot.joint_names[joint]
        keep = [tuple(column[recent] for column in trace) for trace in traces]
        ago = keep[0][0] - keep[0][0][-1]
        bounds = source.effort_limits(robots[0], joint)
        peak = max(float(np.abs(trace[3]).max()) for trace in keep)
        limits = tuple(np.full(len(ago), min(max(bound, -_FAR), _FAR)) for bound in bounds)
        near = [
            limit for limit in limits if abs(limit[0]) < _NEAR * peak
        ]  # a far one would flatten the curve
        efforts = [trace[3] for trace in keep]
        positions = [*(trace[1] for trace in keep), keep[0][2]]
        errors = [trace[2] - trace[1] for trace in keep]
        least = 0.02 * min(abs(limits[0][0]), 100.0)
        for chart, title, columns, seen, span in (
            (self._position, f"{name} [{unit}]", positions, positions, _LEAST[unit]),
            (self._error, f"setpoint - qpos [{unit}]", errors, errors, _LEAST[unit]),
            (self._effort, f"effort [{force}]", [*limits, *efforts], [*near, *efforts], least),
        ):
            if chart.title != title:
                chart.title = title
            self._fit(chart, min(map(np.min, seen)), max(map(np.max, seen)), span)
            chart.data = (ago, *columns)

    def _fit(self, chart: Any, low: float, high: float, least: float) -> None:
        """Let a chart's axis cover ``low`` to ``high``; it stays as it is while that fits, for a calmer picture."""
        room = max(0.1 * (high - low), (least - (high - low)) / 2)
        below, above = chart.scales["y"]["range"]
        if low < below or high > above or 2.5 * (high - low + 2 * room) < above - below:
            chart.scales = _scales(low - room, high + room)


def _scales(low: float, high: float) -> dict[str, Any]:
    # A range of its own would make the time axis drift in viser 1.1, and what is not finite would empty the chart.
    return {"x": {"time": False, "range": (-WINDOW, 0.0)}, "y": {"range": (float(low), float(high))}}


def _dashed(label: str, colour: str) -> dict[str, Any]:
    return {"label": label, "stroke": colour, "width": 1, "dash": [6, 4]}
