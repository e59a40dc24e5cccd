"""Cases of the benchmark move their robots and have a rate; robots that do not move are refused."""

import dataclasses
import importlib.util

import numpy as np
import pytest
from measure import CASES, MUJOCO_LOOPS, OURS, measure_rates
from peers import PEERS
from robots import load_bundled
from workload import Workload, run_round


@pytest.fixture(scope="module")
def workload():
    return Workload(load_bundled("panda"), num_envs=4, workers=0, ticks=60, rounds=1)


@pytest.mark.slow
def test_every_case_moves_and_has_a_rate(workload):
    names = [*CASES, *(MUJOCO_LOOPS if importlib.util.find_spec("mujoco") is not None else ())]
    results = measure_rates(workload, names)
    assert list(results) == names
    assert all(result.rate > 0 and len(result.rates) == 1 for result in results.values())
    # All drives bring the robot to the same place; so do the PIDs, the tutorial's and ours.
    places = {case: result.final for case, result in results.items()}
    assert np.abs(places["tutorial"] - places["closed loop"])[workload.moving].max() < 0.06
    assert np.abs(places["bare engine"] - places["bare engine, robot by robot"]).max() < 1e-6
    np.testing.assert_array_equal(places["closed loop"], places["closed loop, tick by tick"])


def test_robots_that_rest_are_refused(workload):
    with pytest.raises(RuntimeError, match=r"did not move.*run more ticks"):
        measure_rates(dataclasses.replace(workload, ticks=1), [OURS])


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name.startswith("gymnasium") else ())
        for name in PEERS
        if name != "gymnasium, all envs"
    ],
)
def test_peers_reach_the_same_place_in_every_round(workload, name):
    package, make = PEERS[name]
    pytest.importorskip(package)
    peer = make(workload)
    try:
        seconds, final = run_round(peer)
        _, again = run_round(peer)
    finally:
        peer.close()
    assert seconds > 0
    assert peer.env_steps == workload.ticks * workload.substeps * (
        workload.num_envs if name == "mujoco" else 1
    )
    workload.check_motion(name, final)
    np.testing.assert_array_equal(again, final)


def test_mujoco_runs_the_whole_pid(workload):
    """With the integral it ends nearer to the tutorial's loop than without."""
    settings = workload.robot.settings

    def final(ki):
        robot = dataclasses.replace(workload.robot, settings=dataclasses.replace(settings, ki=ki))
        return run_round(PEERS["mujoco"][1](dataclasses.replace(workload, robot=robot)))[1]

    moved = np.abs(final(settings.ki) - final(0 * settings.ki))[workload.moving]
    assert moved.max() > 1e-3
