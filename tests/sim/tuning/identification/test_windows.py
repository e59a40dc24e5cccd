"""Plants that simulate windows never belong to another robot, other joints or another drive."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from tiny_urdf import joint, link, robot, write

import batchpid as bp
from batchpid.sim import Robot
from batchpid.sim.identification import Log
from batchpid.sim.identification.logged_control import LoggedDrive
from batchpid.sim.identification.plant import Segment
from batchpid.sim.identification.regression import smooth
from batchpid.sim.identification.unknowns import Unknowns
from batchpid.sim.identification.windows import Subject, plant_of, whole

GAINS = st.lists(st.integers(0, 3).map(float), min_size=2, max_size=2)
DRIVES = st.fixed_dictionaries(
    {
        "timestep": st.sampled_from([1 / 2000, 1 / 500]),
        "params": st.none() | st.fixed_dictionaries({"kp": GAINS, "kd": GAINS}),
        "compensate": st.sampled_from(["none", "gravity", "gravity+coriolis"]),
        "through": st.booleans(),
        "noisy": st.booleans(),
        "substeps": st.integers(1, 3),
    }
)
ARM = robot(*(link(name) for name in "abc"), joint("one", "a", "b"), joint("two", "b", "c"))


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> Robot:
    return Robot.load(write(tmp_path_factory.mktemp("arm"), ARM))


def drive_of(options: dict) -> LoggedDrive:
    params = options["params"]
    return LoggedDrive(**{**options, "params": None if params is None else bp.make_params(2, **params)})


@settings(max_examples=30, deadline=None)
@given(DRIVES, DRIVES)
def test_drives_share_a_plant_only_if_they_are_the_same(arm, one, two):
    first, second = (Subject.of(arm, (0, 1), drive_of(each)) for each in (one, two))
    assert (first.key == second.key) == (one == two)
    assert (plant_of(first) is plant_of(second)) == (one == two)


@given(GAINS)
def test_permuted_gains_do_not_share_a_plant(arm, gains):
    assume(gains[0] != gains[1])
    one, two = (LoggedDrive(1 / 2000, bp.make_params(2, kp=kp, kd=1.0), "none") for kp in (gains, gains[::-1]))
    assert repr(one) == repr(two)
    moved = [positions(plant_of(Subject.of(arm, (0, 1), each))) for each in (one, two)]
    assert not np.array_equal(*moved)


def positions(plant) -> np.ndarray:
    ones, zeros = np.ones(2), np.zeros((1, 2))
    motors = Unknowns.of(ones, ones, ones, ones, payload=True).motors(np.array([[*zeros[0]] * 3 + [1, 1] + [0] * 5]))
    command = np.full((20, 2), 0.1)
    return plant.simulate(motors, [Segment(zeros[0], zeros[0], command, np.zeros_like(command))], 0)


def test_robots_that_differ_do_not_share_a_plant(arm, tmp_path):
    drive = LoggedDrive(1 / 2000, None, "none")
    heavier = Robot.load(write(tmp_path, ARM.replace('mass value="1"', 'mass value="2"', 1)))
    limited = replace(arm, joints=tuple(replace(each, upper=0.5) for each in arm.joints))
    subjects = [Subject.of(each, (0, 1), drive) for each in (arm, heavier, limited)] + [Subject.of(arm, (0,), drive)]
    assert len({subject.key for subject in subjects}) == 4
    assert len({id(plant) for plant in [plant_of(subject) for subject in subjects]}) == 4


def test_threads_do_not_share_plants(arm):
    subject, found = Subject.of(arm, (0, 1), LoggedDrive(1 / 2000, None, "none")), [None]
    thread = threading.Thread(target=lambda: found.append(plant_of(subject)))
    thread.start()
    thread.join()
    assert found[1] is not plant_of(subject) is plant_of(subject)


@pytest.mark.parametrize("phase", [0.0, 0.5, 1.2])
def test_a_stretch_begins_with_the_velocity_that_its_rows_show(phase):
    """At rest, as in most logs, or during a motion, where a gap ended."""
    time = np.arange(1000) / 1000
    noise = 5e-4 * np.random.default_rng(0).standard_normal((1000, 1))
    qpos = 0.5 * (1 - np.cos(3 * time + phase))[:, None]
    log = Log("log", (0,), "setpoint", time, qpos + noise, time, qpos, False)
    (window,) = whole(0, log, smooth(log, 1 / 1000), 1 / 1000)
    assert window.segment.qvel[0] == pytest.approx(1.5 * np.sin(phase), abs=0.15)
