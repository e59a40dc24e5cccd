"""Cases of the benchmark move their robots and have a rate; robots that do not move are refused."""

import dataclasses
import importlib.util

import numpy as np
import pytest

from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from batchpid.sim.benchmark.benchmark import cases_in, measure_phases, measure_rates
from batchpid.sim.benchmark.peers import PEERS, make_peers
from batchpid.sim.benchmark.workload import Workload, run_round


@pytest.fixture(scope="module")
def workload(panda):
    return Workload(panda, num_envs=4, workers=0, ticks=60, rounds=1)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["sapien", "mujoco"])
def test_every_case_moves_and_has_a_rate(workload, engine):
    pytest.importorskip("mujoco.batch" if engine == "mujoco" else "sapien")
    names = cases_in(engine, mujoco=importlib.util.find_spec("mujoco") is not None)
    results = measure_rates(dataclasses.replace(workload, engine=engine), names=names)
    assert list(results) == list(names)
    assert all(result.rate > 0 and len(result.rates) == 1 for result in results.values())
    # All drives bring the robot to the same place; so do the PIDs, the tutorial's and ours.
    places = {case: result.final for case, result in results.items()}
    if engine == "sapien":  # with the friction of the tutorial's loop
        assert np.abs(places["tutorial"] - places["closed loop"])[workload.moving].max() < 0.06
        assert np.abs(places["bare engine"] - places["bare engine, robot by robot"]).max() < 1e-6
    np.testing.assert_array_equal(places["closed loop"], places["closed loop, tick by tick"])


def test_robots_that_rest_are_refused(workload):
    with pytest.raises(BatchPIDError, match="did not move"):
        workload.check_motion("some case", workload.start)


def test_robot_without_gains_is_refused(panda):
    with pytest.raises(InvalidArgumentError, match="robot"):
        Workload(dataclasses.replace(panda, settings=None))


@pytest.mark.slow
def test_phases_are_positive_and_the_engine_takes_most(workload):
    spent = measure_phases(workload)
    assert list(spent) == ["read", "control", "passive", "write", "step", "waiting"]
    assert all(value > 0 for value in spent.values())
    assert spent["step"] == max(spent[phase] for phase in ("read", "passive", "write", "step"))


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name.startswith("gymnasium") else ())
        for name in PEERS
        if name != "gymnasium, all envs"
    ],
)
def test_peers_reach_the_same_place_in_every_round(workload, name):
    pytest.importorskip(PEERS[name].package)
    peer = make_peers(workload, [name])[name]
    try:
        seconds, final = run_round(peer)
        _, again = run_round(peer)
    finally:
        peer.close()
    assert seconds > 0
    assert peer.env_steps == workload.ticks * workload.substeps * (workload.num_envs if name == "mujoco" else 1)
    workload.check_motion(name, final)
    np.testing.assert_array_equal(again, final)


def test_mujoco_runs_the_whole_pid(workload):
    """With the integral it ends nearer to the tutorial's loop than without."""
    pytest.importorskip("mujoco")
    settings = workload.robot.settings

    def final(ki):
        robot = dataclasses.replace(workload.robot, settings=dataclasses.replace(settings, ki=ki))
        peer = make_peers(dataclasses.replace(workload, robot=robot), ["mujoco"])["mujoco"]
        try:
            return run_round(peer)[1]
        finally:
            peer.close()

    moved = np.abs(final(settings.ki) - final(0 * settings.ki))[workload.moving]
    assert moved.max() > 1e-3


def test_peer_that_is_not_installed_is_named_with_its_extra(workload, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match="peers"):
        make_peers(workload, ["mujoco"])
