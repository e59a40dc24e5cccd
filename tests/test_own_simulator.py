"""The examples of other simulators in docs/controllers.md are short and complete, and do what the
page says.
"""

import numpy as np
import pytest
from pages import ROOT, blocks

PAGE = ROOT / "docs/controllers.md"
CODES = [match["code"] for match in blocks(PAGE, "python")]
FIRST = next(at for at, code in enumerate(CODES) if "ARM = " in code)
MODEL, PLAIN, MJX = CODES[FIRST : FIRST + 3]
LONGEST = 30
"""Lines of an example, without blank ones."""


@pytest.fixture
def namespace():
    values = {"__name__": "__main__"}
    exec(MODEL, values)
    exec(PLAIN.split("pid = ")[0], values)
    return values


@pytest.mark.parametrize("code", [PLAIN, MJX], ids=["plain", "mjx"])
def test_each_example_is_short(code):
    assert len([line for line in code.splitlines() if line.strip()]) <= LONGEST


def test_plain_mujoco_reaches_every_setpoint(namespace):
    exec(PLAIN, namespace)
    assert np.abs(namespace["setpoint"] - namespace["qpos"]).max() < 1e-2
    assert (np.abs(namespace["effort"]) <= namespace["params"].effort_max).all()


@pytest.mark.slow
def test_gradients_through_mjx_are_those_of_differences(namespace):
    pytest.importorskip("mujoco.mjx")
    import jax

    exec(MJX, namespace)
    jnp, gradients = namespace["jnp"], np.asarray(namespace["gradients"])
    assert (gradients < 0).all()
    error = jax.jit(namespace["error"])
    for at, setpoint in enumerate(namespace["setpoints"]):
        for joint, kp in enumerate((80.0, 30.0)):
            step = jnp.zeros(2).at[joint].set(0.05 * kp)
            high, low = (error(jnp.array([80.0, 30.0]) + sign * step, setpoint) for sign in (1, -1))
            assert gradients[at, joint] == pytest.approx(float(high - low) / (0.1 * kp), rel=0.05)
