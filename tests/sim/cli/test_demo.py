"""batchpid demo: a run, its report and its picture."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from robots import load_bundled

import batchpid as bp

SHORT = ("--num-envs", 2, "--workers", 0, "--seconds", 0.02)


@pytest.mark.usefixtures("undrawn")
def test_demo_reports_every_joint_and_where_it_differs_from_the_tutorial(batchpid, tmp_path):
    robot, path = load_bundled("panda"), tmp_path / "mine.yaml"
    bp.save_params(path, robot.params(kp=7.0), robot.joint_names)
    titles = {
        path: f"gains {path}, 2000 Hz, 2 robots",
        "drive:30,6": "SAPIEN, gains drive:30,6, 2000 Hz, 2 robots",
    }
    for gains, title in titles.items():
        status, said, _ = batchpid("demo", *SHORT, "--gains", gains, "--force")
        assert status == 0
        assert title in said
    assert "panda_joint4 goes to -1 rad" in said
    assert "NOT SETTLED" in said
    assert all(f"\n{joint} " in said for joint in robot.joint_names)


@pytest.mark.slow
def test_demo_draws(batchpid, tmp_path):
    path = tmp_path / "demo.png"
    status, said, _ = batchpid("demo", "jaco2", *SHORT, "--workers", 1, "--picture", path)
    assert status == 0
    lines = ("env-steps/s", "real-time factor", str(path))
    assert all(line in said for line in lines)
    with Image.open(path) as picture:
        assert picture.width > 1000
        assert len(np.unique(np.asarray(picture))) > 20
