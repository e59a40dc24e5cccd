"""Robots that do not settle, each for another cause: the cause is named, right, and first."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pytest
from tiny_urdf import write

import batchpid as bp
from batchpid.errors import InvalidArgumentError
from batchpid.sim import (
    FaultWarning,
    Randomization,
    Robot,
    Runner,
    Uniform,
    read_recording,
    write_recording,
)

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*outside the joint limits", "ignore::batchpid.sim.FaultWarning"
)


def bar(length, mass=1.0):
    """Return the contents of a link: a bar along x, with its mass and its shape."""
    moments = f'ixx="0.001" iyy="{mass * length**2 / 12:.6f}" izz="{mass * length**2 / 12:.6f}"'
    place = f'<origin xyz="{length / 2} 0 0"/>'
    return (
        f'<inertial>{place}<mass value="{mass}"/><inertia {moments} ixy="0" ixz="0"'
        f' iyz="0"/></inertial><collision>{place}<geometry><box size="{length - 0.06} 0.05'
        ' 0.05"/></geometry></collision>'
    )


def arm(axis="0 1 0", effort=60.0, friction=0.0, fixed_base=True):
    """Return an arm of three bars, 0.3 m each, that turn about y, 0.5 m above its base; ``axis`` is
    the elbow's.
    """
    mass = '<mass value="50"/><inertia ixx="9" iyy="9" izz="9" ixy="0" ixz="0" iyz="0"/>'
    parts = [f'<link name="base"><inertial>{mass}</inertial></link>']
    for number, (name, turns) in enumerate(
        [("shoulder", "0 1 0"), ("elbow", axis), ("wrist", "0 1 0")]
    ):
        above, at = ("base", "0 0 0.5") if number == 0 else (f"bar{number}", "0.3 0 0")
        parts.append(f'<link name="bar{number + 1}">{bar(0.3)}</link>')
        parts.append(
            f'<joint name="{name}" type="revolute"><parent link="{above}"/><child'
            f' link="bar{number + 1}"/><origin xyz="{at}"/><axis xyz="{turns}"/><dynamics'
            f' friction="{friction}" damping="0.02"/><limit lower="-3" upper="3"'
            f' effort="{effort if name == "elbow" else 60}" velocity="9"/></joint>'
        )
    with tempfile.TemporaryDirectory() as folder:
        return Robot.load(
            write(Path(folder), f'<robot name="arm">{"".join(parts)}</robot>'),
            fixed_base=fixed_base,
        )


class Case(NamedTuple):
    """A run that does not settle, and the finding that names its cause."""

    code: str
    place: str
    """Joint, link or words that are named."""
    setpoint: tuple[float, ...]
    start: tuple[float, ...] = (0.0, 0.0, 0.0)
    robot: Mapping[str, Any] = MappingProxyType({})
    gains: Mapping[str, Any] = MappingProxyType({})
    """Arguments of robot.params(); none for the designed gains."""
    options: Mapping[str, Any] = MappingProxyType({})
    seconds: float = 2.0
    moves: bool = False
    """True if the setpoint is a ramp up to the end of the run."""


LAGGING = bp.make_actuators(3, command_delay=[0.09, 0.0, 0.0])
STIFF = {"kp": 200.0, "kd": [20.0, 12.0, 5.0]}
WEAK = {"kp": [200.0, 8.0, 200.0], "kd": [12.0, 10.0, 2.0]}
LOADED = {"compensate": "none"}
"""Options without compensation of gravity."""
CASES = {
    "pressed into the ground": Case("touching", "bar3 on the ground", (0.7, 0.3, 0.0)),
    "along the ground, into which single joints press": Case("touching", "bar3 on the ground", (1.3, -0.3, -1.0)),
    "links that touch": Case("touching", "bar1", (-0.3, 2.3, 2.4)),
    "a start inside the ground": Case("touching", "bar3 on the ground", (0.75, 0.3, 0.0), start=(0.75, 0.3, 0.0)),
    "gravity above the effort limit": Case("effort-limit", "elbow", (0.0, -0.5, 0.0), robot={"effort": 3.0}),
    "a move too long for the effort limit": Case(
        "effort-limit", "elbow", (0.0, 2.9, 0.0), robot={"axis": "0 0 1", "effort": 1.0}, seconds=1.0
    ),
    "links that touch in free fall": Case(
        "touching", "bar1", (-0.3, 2.3, 2.4), robot={"fixed_base": False}, options={"ground": False}
    ),
    "a drive that is too weak": Case(
        "effort-limit", "elbow", (0.0, -0.5, 0.0), robot={"effort": 3.0}, gains={"kp": 500.0, "kd": 50.0},
        options={"control": "drive", **LOADED},
    ),
    "a setpoint outside the limits": Case("out-of-limits", "wrist", (0.0, 0.0, -3.4)),
    "a run that diverges": Case(
        "failed", "lower the gains", (0.1, 0.1, 0.1), gains={"kp": 9e3, "kd": 9e3, "effort_limit": np.inf},
        seconds=0.5,
    ),
    "gains beyond the stability bound": Case("oscillates", "wrist", (0.1, 0.1, 0.1), gains={"kp": 900.0, "kd": 90.0}),
    "gains that ring": Case("oscillates", "shoulder", (0.5, 0.0, 0.0), gains={"kp": 300.0, "kd": 0.05}),
    "no integral action": Case("gains", "shoulder", (-0.5, 0.0, 0.0), gains=STIFF, options=LOADED),
    "friction": Case(
        "gains", "wrist", (0.0, 0.0, 0.1), robot={"friction": 4.0}, gains={"kp": 30.0, "kd": 3.0},
        options={"compensate": "gravity"},
    ),
    "a run too short": Case("slow", "elbow", (0.0, 0.5, 0.0), gains=WEAK, seconds=0.5),
    "an unknown payload": Case(
        "blocked", "shoulder", (0.2, 0.0, 0.0), gains={"kp": 300.0, "kd": [40.0, 15.0, 5.0]},
        options={"randomization": Randomization(payload=Uniform(4.0, 4.1), payload_link="bar3")},
    ),
    "a setpoint that still moves": Case(
        "slow", "elbow", (0.0, 1.0, 0.0),
        gains={"kp": 100.0, "kd": [20.0, 12.0, 2.0]}, moves=True,
    ),
    "a delay of the motors": Case("oscillates", "shoulder", (0.3, 0.0, 0.0), options={"actuators": LAGGING}),
    "a joint without gains": Case("gains", "elbow", (0.0, 0.5, 0.0), gains={"kp": [200.0, 0, 200], "kd": 12.0}),
    "a guard": Case(
        "guard", "elbow", (0.0, 1.0, 0.0), options={"guard": bp.make_guard(3, rate=0.2)}, seconds=1.0
    ),
    "an integral at its limit": Case(
        "gains", "shoulder", (-0.5, 0.0, 0.0), gains={**STIFF, "ki": 300.0, "integral_limit": 0.01},
        options=LOADED,
    ),
}  # fmt: skip
ENGINES = ("sapien", "mujoco")


def run(case, engine, envs=1):
    """Return the run of a case: setpoints held, or for one that still moves a ramp."""
    robot = arm(**case.robot)
    params = robot.params(**case.gains) if case.gains else robot.designed()
    ticks = round(case.seconds / 0.01)
    share = np.linspace(0.0, 1.0, ticks)[:, None, None] if case.moves else np.ones((ticks, 1, 1))
    with Runner(robot, envs, workers=0, params=params, engine=engine, **case.options) as runner:
        runner.reset(case.start)
        return runner.rollout(share * np.array(case.setpoint))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", CASES)
def test_the_cause_is_named_and_first(name, engine):
    case = CASES[name]
    rollout = run(case, engine)
    findings = rollout.findings()
    first = findings[0]
    assert {finding.code for finding in findings} == {case.code}
    assert case.place in str(findings)
    assert first.envs == (0,)
    assert 0 <= first.time <= rollout.time[-1]


def test_a_run_that_settles_has_no_findings():
    with Runner(arm(), 2, workers=0, engine="mujoco") as runner:
        assert runner.rollout(np.tile([-0.3, 0.2, 0.1], (200, 1))).findings() == []


def test_without_collisions_there_is_no_contact_to_name():
    case = CASES["pressed into the ground"]
    robot = arm()
    with Runner(robot, 1, workers=0, engine="mujoco", collisions=False) as runner:
        assert runner.rollout(np.tile(case.setpoint, (200, 1))).findings() == []


def test_causes_are_in_the_order_of_the_rules():
    """Two envs are pressed into the ground, and one has a setpoint beyond a limit."""
    setpoints = np.tile(
        [[0.7, 0.3, 0.0], [0.0, 0.0, -3.4], [0.7, 0.3, 0.0], [0.0, 0.0, 0.1]], (200, 1, 1)
    )
    with Runner(arm(), 4, workers=0, engine="mujoco") as runner:
        found = runner.rollout(setpoints).findings()
    assert [(each.code, sorted(each.envs)) for each in found] == [
        ("out-of-limits", [1]),
        ("touching", [0, 2]),
    ]
    assert "env 0 and 1 more" in str(found[1]) or "env 2 and 1 more" in str(found[1])


def test_an_input_that_is_not_finite_is_the_cause():
    setpoints = np.zeros((20, 2, 3))
    setpoints[7, 1, 2] = np.nan
    with (
        Runner(arm(), 2, workers=0, engine="mujoco", on_invalid_input="contain") as runner,
        pytest.warns(FaultWarning),
    ):
        (found,) = runner.rollout(setpoints).findings()
    assert (found.code, found.envs, found.detail) == ("failed", (1,), "wrist: setpoint")
    assert found.time == pytest.approx(0.07, abs=0.011)


def test_of_a_tool_only_failures_are_found(panda):
    with Runner(panda, 1, workers=0, engine="mujoco", control="osc", tool="panda_hand") as runner:
        pose = runner.reset().tool_pose[0].astype(float)
        assert runner.rollout(np.tile(pose + np.eye(7)[0], (20, 1))).findings() == []


@pytest.mark.parametrize("kp", [3.0, 20.0])
def test_a_joint_at_its_turning_point_is_not_blocked(kp):
    """It swings in free air, and is at rest for a moment."""
    robot = arm()
    params = robot.params(kp=kp, kd=0.05)
    with Runner(robot, 1, workers=0, engine="mujoco", params=params, ground=False) as runner:
        rollout = runner.rollout(np.tile([0.0, 0.3, 0.0], (200, 1)))
    for ticks in range(30, 200, 10):
        assert "blocked" not in {each.code for each in rollout.for_ticks(0, ticks).findings()}


def test_a_recording_needs_its_robot(tmp_path):
    case = CASES["a setpoint outside the limits"]
    rollout, path = run(case, "mujoco"), tmp_path / "run.h5"
    write_recording(rollout, path)
    read = read_recording(path)
    with pytest.raises(InvalidArgumentError, match="robot: is unknown for this run"):
        read.findings()
    assert str(read.findings(arm())) == str(rollout.findings())
    with pytest.raises(InvalidArgumentError, match="other joints"):
        read.findings(Robot.load("panda"))


def test_more_envs_than_are_examined():
    rollout = run(CASES["a setpoint outside the limits"]._replace(seconds=0.8), "mujoco", envs=130)
    (found,) = rollout.findings()
    assert len(found.envs) == 100
    assert dataclasses.replace(found).where == "joint 'wrist'"
