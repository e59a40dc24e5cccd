"""Names on the control panel."""

from batchpid.sim.view.panel import short_names


def test_joint_names_lose_the_words_that_all_share(panda, jaco2):
    assert short_names(panda) == (*(f"joint{k}" for k in range(1, 8)), "finger_joint1", "finger_joint2")
    assert short_names(jaco2)[6:8] == ("joint_7", "finger_1")
