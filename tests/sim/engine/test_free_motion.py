"""Robots without contact step in vectors of native code; the oracle is MuJoCo's own step, without
native code.
"""

import os

import numpy as np
import pytest
from featured import robot_with
from robots import load_bundled
from tiny_urdf import random_tree, robot, write

from batchpid.sim import MujocoSolver, Randomization, Robot, Runner, Uniform
from batchpid.sim.engine import native
from batchpid.stages import control_segments

pytestmark = [
    pytest.mark.filterwarnings("ignore::UserWarning"),
    pytest.mark.skipif(
        os.environ.get("BATCHPID_NATIVE") == "0", reason="there are no native calls"
    ),
]
VARIED = Randomization(
    payload=Uniform(0.0, 3.0),
    link_mass=Uniform(0.7, 1.3, operation="scale"),
    armature=Uniform(1e-3, 0.1),
    gravity={"x": Uniform(-1, 1), "z": Uniform(-1, 1)},
    seed=1,
)

WRENCHES = ["panda_link1", "panda_link5", "panda_hand", "panda_leftfinger"]
"""Links below joints that turn and slide, and links of fixed joints."""


def motion(of, monkeypatch, natively, to_limits, ticks, envs=8, **options):
    """Return a rollout to random targets, of which some are at limits, with a reset of some robots
    at half of it.
    """
    monkeypatch.setenv("BATCHPID_NATIVE", str(int(natively)))
    rng = np.random.default_rng(2)
    low, high = np.maximum(of.lower, -2.5), np.minimum(of.upper, 2.5)
    goals = of.start + 0.4 * (rng.uniform(low, high, (2, envs, of.dof)) - of.start)
    ends = np.where(rng.random(goals.shape) < 0.5, of.lower, of.upper)
    at_end = to_limits & np.isfinite(ends) & (rng.random(goals.shape) < 0.5)
    goals = of.coupling.positions(np.where(at_end, ends, np.clip(goals, of.lower, of.upper)))
    rows = np.repeat(goals, ticks // 2, axis=0)
    # MuJoCo's default tolerance leaves errors of 1e-5 rad where joints strike their limits.
    options |= {"physics": MujocoSolver(tolerance=1e-13), "workers": 0, "ground": False}
    with Runner(of, envs, engine="mujoco", **options) as runner:
        runner.reset()
        first = runner.rollout(rows)
        runner.reset(mask=np.arange(envs) % 3 == 0)
        return first, runner.rollout(rows)


def arm(name, folder):
    """Return a robot by name, or a random tree."""
    if isinstance(name, int):
        return Robot.load(write(folder, robot(*random_tree(np.random.default_rng(name), 8))))
    return load_bundled(name) if name in Robot.bundled() else robot_with(name)


CASES = [
    ("panda", False, {}),
    ("panda", True, {}),
    ("panda", False, {"randomization": VARIED}),
    ("panda", False, {"contacts": ["panda_hand"], "wrenches": WRENCHES}),
    ("panda", False, {"wrenches": WRENCHES, "randomization": VARIED}),
    ("panda", False, {"control": "drive"}),
    ("panda", True, {"control": "drive", "randomization": VARIED}),
    ("jaco2", False, {}),
    ("sliding mimic", False, {}),
    *((seed, True, {}) for seed in range(3)),
]


@pytest.mark.parametrize(("name", "to_limits", "options"), CASES)
def test_a_motion_is_that_of_mujoco(name, to_limits, options, tmp_path, monkeypatch):
    """Positions and efforts equal MuJoCo's in float32, and within 1e-6 where joints chatter at
    their limits, which amplifies rounding.
    """
    of = arm(name, tmp_path)
    ours, theirs = (
        motion(of, monkeypatch, natively, to_limits, 20, **options) for natively in (True, False)
    )
    tolerance = 1e-6 if to_limits else 0.0
    for one, other in zip(ours, theirs, strict=True):
        reach = np.abs(other.qpos).max()
        np.testing.assert_allclose(one.qpos, other.qpos, rtol=1e-7, atol=tolerance * reach)
        largest = np.abs(other.effort).max()
        np.testing.assert_allclose(
            one.effort, other.effort, rtol=1e-7, atol=(tolerance or 1e-9) * largest
        )
        if "wrenches" in options:
            np.testing.assert_allclose(one.wrench, other.wrench, rtol=1e-5, atol=1e-5)


def test_default_controls_are_passes(monkeypatch):
    """Programs of arms under default gains have no segment that the interpreter runs."""
    gateway, used = native.extension("_gateway"), set()

    def bind(arguments, *arrays):
        used.update(segment[2] for segment in arguments[2])
        return bound(arguments, *arrays)

    bound = gateway.bind
    monkeypatch.setattr(gateway, "bind", bind)
    for name in ("panda", "jaco2"):
        of = load_bundled(name)
        with Runner(of, 2, engine="mujoco", workers=0) as runner:
            runner.reset()
            runner.step(of.target)
            runner.step(of.target, setpoint_rate=0.0)
    assert used
    assert used <= {segment.code for segment in control_segments()}
