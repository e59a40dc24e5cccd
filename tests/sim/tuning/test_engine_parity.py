"""Comparison of the engines: different where one simulates another robot. The command is in tests/sim/cli."""

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("mujoco.batch")

from tiny_urdf import joint, link, robot, write

from batchpid.sim import Robot
from batchpid.sim.engine.mujoco import model_builder
from batchpid.sim.tuning import compare_engines


def forget():
    """Drop the models that were built."""
    model_builder.robot_model.cache_clear()


@pytest.mark.slow
def test_another_mass_is_found(panda, monkeypatch):
    inertias = model_builder.body_inertias

    def heavier(spec):
        return {name: each._replace(mass=1.2 * each.mass) for name, each in inertias(spec).items()}

    monkeypatch.setattr(model_builder, "body_inertias", heavier)
    forget()
    try:
        found = compare_engines(panda, moves=1, seconds=1.0, workers=0)
    finally:
        forget()
    assert found.bias > 0.1
    said = " ".join(found.verdict())
    assert "do NOT simulate the same robot" in said
    assert "more than rounding explains" in said
    # The gains cope with it.
    assert np.isfinite(found.closed_loop).all()


def test_a_joint_without_range_does_not_end_the_comparison(tmp_path):
    held = joint("held", "arm", "tip", inner='<limit lower="0" upper="0" effort="10"/>')
    text = robot(*map(link, ("base", "arm", "tip")), joint("hinge", "base", "arm"), held)
    found = compare_engines(Robot.load(write(tmp_path, text)), moves=1, seconds=0.2, workers=0)
    assert found.open_loop[-1] > 0
    assert 0 < found.first_chaos < 1e-3  # the scale of rounding, for first_tick
    at_limits = found._replace(open_loop=np.full_like(found.open_loop, np.nan))
    assert "NOTHING was compared" in " ".join(at_limits.verdict())
