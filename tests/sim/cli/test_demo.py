"""batchpid demo: a run, its report and its picture."""

import pytest
from robots import load_bundled

SHORT = ("--num-envs", 2, "--seconds", 0.02)


@pytest.mark.usefixtures("undrawn")
def test_demo_reports_every_joint(batchpid):
    status, said, _ = batchpid("demo", *SHORT)
    assert (status, said.splitlines()[0]) == (
        0,
        "panda: 9 dof",
    )
    assert "panda_joint4 goes to -1 rad" in said
    assert "WHY: " in said
    assert all(f"\n{joint} " in said for joint in load_bundled("panda").joint_names)
