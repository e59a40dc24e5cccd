"""Ticks of a rollout in one native call: the same as ticks one by one, also where something happens in one of them."""

import numpy as np
import pytest
from robots import load_bundled

import batchpid as bp
from batchpid.sim import Runner
from batchpid.sim.engine import native
from batchpid.sim.loop.native_ticks import NativeTicks

pytestmark = [
    pytest.mark.filterwarnings("ignore::batchpid.sim.FaultWarning", "ignore::batchpid.sim.StabilityWarning"),
    pytest.mark.skipif(bool(native.obstacle()), reason="there are no native calls"),
]


@pytest.fixture(params=["sapien", "mujoco"])
def engine(request):
    if request.param == "mujoco":
        pytest.importorskip("mujoco")
    return request.param


@pytest.fixture
def panda():
    return load_bundled("panda")


@pytest.mark.parametrize("options", [{}, {"speed_limit": 0.5}, {"on_fault": "reset"}], ids=str)
def test_a_rollout_is_its_ticks_one_by_one(panda, engine, options):
    options = {"workers": 0, "substeps": 7, "engine": engine, "on_invalid_input": "contain", **options}
    setpoints = np.broadcast_to(panda.settings.target, (9, 3, panda.dof)).copy()
    setpoints[4, 1, 2] = np.nan
    with Runner(panda, 3, **options) as whole, Runner(panda, 3, **options) as single:
        rollout = whole.rollout(setpoints)
        ticks = [single.step(rows) for rows in setpoints]
        assert not rollout.ok[4].all()
        for name in ("qpos", "qvel", "effort", "saturated", "ok", "guarded"):
            np.testing.assert_array_equal(getattr(rollout, name), np.stack([getattr(tick, name) for tick in ticks]))
        assert whole.faults == single.faults
        np.testing.assert_array_equal(whole.observe().qpos, rollout.qpos[-1])


OPTIONS = {
    "pid": {},
    "drive": {"control": "drive"},
    "guarded drive": {"control": "drive", "guard": True},
    "sensors": {"actuators": bp.make_actuators(9, sensor_delay=0.002, lag=0.003)},
    "no measured rate": {"gains": {"measurement_rate": "difference"}},
}


@pytest.mark.parametrize("name", OPTIONS)
def test_ticks_are_one_call_until_an_event(panda, engine, name, monkeypatch):
    options, calls, run = dict(OPTIONS[name]), [], NativeTicks.run
    if "gains" in options:
        options["params"] = panda.params(gain_units="effort", kp=300.0, kd=30.0, **options.pop("gains"))

    def counted(self, step, tick, begin, until, steps, whole):
        calls.append(until - tick)
        return run(self, step, tick, begin, until, steps, whole)

    monkeypatch.setattr(NativeTicks, "run", counted)
    with Runner(panda, 2, workers=0, substeps=2, engine=engine, **options) as runner:
        rollout = runner.rollout(np.broadcast_to(panda.settings.target, (30, panda.dof)))
    assert calls == [30]
    assert np.ptp(rollout.qpos, axis=0).max() > 1e-3
    assert np.abs(rollout.qvel[-1]).max() > 0
