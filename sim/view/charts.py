"""The charts of one joint: position and setpoint, error, effort within its limits."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim.view.data import Source

_INK = {"setpoint": "#4a82ff", "limit": "#b6bcc6"}
_COLOURS = ("#15803d", "#d97706", "#7c3aed")
"""The first group's curve, the second's, ..."""
_NEAR = 4.0
"""A limit is drawn once it is less than so many times the effort."""
_LEAST = 0.012
"""Every axis reaches from below minus so much to above it [rad, m, N m or N]: noise alone should not fill a chart."""
_SHOWN = 1e-4
"""Positions are drawn in steps of this [rad or m]; what is smaller makes a flat line jitter."""
WINDOW = 8.0
"""How far back the time axis goes [s]: it counts from now."""
_SCALES = {
    "x": {"time": False, "range": (-WINDOW, 0.0)},  # a range of its own would drift in viser 1.1
    "y": {
        "range": {
            "min": {"pad": 0.1, "soft": -_LEAST, "mode": 1},
            "max": {"pad": 0.1, "soft": _LEAST, "mode": 1},
        }
    },
}


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
                scales=_SCALES,
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
        # A far limit would flatten the curve, and a gap (NaN) would empty the chart: it lies under the curve instead.
        limits = [np.full(len(ago), bound) if abs(bound) < _NEAR * peak else keep[0][3] for bound in bounds]
        positions = [*(trace[1] for trace in keep), keep[0][2]]
        for chart, title, columns in (
            (
                self._position,
                f"{name} [{unit}]",
                [_SHOWN * np.round(column / _SHOWN) for column in positions],
            ),
            (self._error, f"setpoint - qpos [{unit}]", [trace[2] - trace[1] for trace in keep]),
            (self._effort, f"effort [{force}]", [*limits, *(trace[3] for trace in keep)]),
        ):
            if chart.title != title:
                chart.title = title
            chart.data = (ago, *columns)


def _dashed(label: str, colour: str) -> dict[str, Any]:
    return {"label": label, "stroke": colour, "width": 1, "dash": [6, 4]}
