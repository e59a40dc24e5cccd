"""The benchmark measures what it says, and refuses to measure robots that do not move."""

import numpy as np
import pytest

from batchpid.errors import BatchPIDError, InvalidArgumentError, MissingDependencyError
from sim import Robot
from sim.benchmark.benchmark import CASES, check_motion, compare, phases
from sim.benchmark.peers import PEERS, make_peer, run_peer
from sim.benchmark.setup import Setup


@pytest.fixture(scope="module")
def setup():
    return Setup(Robot.load("panda"), num_envs=4, workers=1, ticks=100, rounds=1)


def test_every_case_moves_and_has_a_rate(setup):
    results = compare(setup)
    assert list(results) == list(CASES)
    assert all(result.rate > 0 and len(result.rates) == 1 for result in results.values())
    # All drives bring the robot to the same place; so do the PIDs, the tutorial's and ours.
    places = {case: result.final for case, result in results.items()}
    assert np.abs(places["bare engine"] - places["bare engine, pack by pack"]).max() < 1e-6
    np.testing.assert_array_equal(places["closed loop"], places["closed loop, tick by tick"])
    assert np.abs(places["tutorial"] - places["closed loop"])[setup.moving].max() < 0.06


def test_robots_that_rest_are_no_result(setup):
    with pytest.raises(BatchPIDError, match="did not move"):
        check_motion("some case", setup.start, setup)


def test_nothing_to_move_to():
    robot = Robot.load(Robot.load("panda").path)
    bare = Setup(type(robot)(**{**vars(robot), "settings": None}))
    with pytest.raises(InvalidArgumentError, match="robot"):
        compare(bare)


def test_phases_add_up(setup):
    spent = phases(setup)
    assert list(spent) == ["read", "control", "passive", "write", "step", "waiting"]
    assert all(value > 0 for value in spent.values())
    assert spent["step"] == max(spent[phase] for phase in ("read", "passive", "write", "step"))


@pytest.mark.parametrize("name", [name for name in PEERS if name != "gymnasium, all envs"])
def test_peers_reach_the_same_place(setup, name):
    pytest.importorskip(PEERS[name].package)
    peer = make_peer(name, setup)
    try:
        seconds, steps, final = run_peer(peer, setup)
        again = run_peer(peer, setup)
    finally:
        peer.close()
    assert seconds > 0
    assert steps == setup.ticks * setup.substeps * (setup.num_envs if name == "mujoco" else 1)
    check_motion(name, final, setup)
    np.testing.assert_array_equal(again[2], final)


def test_a_peer_that_is_not_installed(setup, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match="peers"):
        make_peer("mujoco", setup)
