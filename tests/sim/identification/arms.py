"""A two-joint arm in the vertical plane, and logs of it from a Runner with known motors."""

from dataclasses import replace

import numpy as np

import batchpid as bp
from batchpid.sim import Robot, Runner
from batchpid.sim.identification import logs_of_rollout

URDF = """<robot name="arm"><link name="base"/>
<link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/>
<inertia ixx="0.03" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.005"/></inertial></link>
<link name="fore"><inertial><origin xyz="0 0 0.15"/><mass value="1"/>
<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.002"/></inertial></link>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.5"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="40" velocity="6"/></joint>
<joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/>
<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="20" velocity="6"/></joint></robot>"""
TRUTH = {
    "armature": [0.05, 0.02],
    "viscous": [0.3, 0.2],
    "coulomb": [0.4, 0.2],
    "strength": [0.9, 0.95],
    "command_delay": 0.0034,
}
DT = 0.001
FALLING = np.array([0.5, 0.3])
STEPS = 5
"""Sim steps of a tick."""
OPTIONS = {"workers": 0, "timestep": DT, "substeps": STEPS, "engine": "mujoco"}


def load(folder, text=URDF):
    """Return the arm."""
    path = folder / "arm.urdf"
    path.write_text(text)
    return Robot.load(path)


def heavier(factor):
    """Return the text of an arm whose forearm has a multiple of its mass and inertia."""
    text = URDF
    for name, value in {"mass value": "1", "ixx": "0.01", "iyy": "0.01", "izz": "0.002"}.items():
        text = text.replace(f'{name}="{value}"', f'{name}="{factor * float(value)}"')
    return text


def motion(seconds=3.0, seed=0):
    """Return setpoints (ticks, 2) that begin at rest."""
    time, rng = np.arange(0, seconds, STEPS * DT)[:, None], np.random.default_rng(seed)
    frequency, phase = np.array([0.4, 0.9, 2.1]), rng.uniform(0, 6, (2, 3))
    waves = np.sin(2 * np.pi * frequency * time[..., None] + phase) @ np.array([0.5, 0.3, 0.1])
    return waves * np.minimum(1.0, time / 0.5) ** 2


def gains():
    """Return the gains of the arm."""
    return bp.make_params(2, [120.0, 40.0], kd=[8.0, 2.0])


def run(robot, setpoints, control="pid", compensate="none", commands=None, **options):
    """Return the rollout of a runner, with further ``commands``, that begins at the first setpoint,
    or at FALLING for efforts.
    """
    actuators = bp.make_actuators(2, **(TRUTH | options.pop("actuators", {})))
    options = OPTIONS | {"control": control, "compensate": compensate} | options
    params = None if control == "effort" else gains()
    with Runner(robot, 1, params=params, actuators=actuators, **options) as runner:
        runner.reset(FALLING if control == "effort" else setpoints[0])
        return runner.rollout(setpoints, **(commands or {}))


def log_of(robot, rollout, noise=0.0, **settings):
    """Return the log of a rollout, with noise of its positions and other settings."""
    (log,) = logs_of_rollout(robot, rollout)
    shaken = log.qpos + noise * np.random.default_rng(1).standard_normal(log.qpos.shape)
    return replace(log, qpos=shaken, **settings)


def effort_run(robot):
    """Return the rollout of efforts that follow :func:`motion` in a loop at the rate of the
    ticks.
    """
    rows = []
    options = OPTIONS | {"control": "effort", "compensate": "none"}
    with Runner(robot, 1, actuators=bp.make_actuators(2, **TRUTH), **options) as runner:
        seen = runner.reset(np.zeros(2))
        for setpoint in motion():
            rows.append([60.0, 20.0] * (setpoint - seen.qpos[0]) - [5.0, 1.0] * seen.qvel[0])
            seen = runner.step(rows[-1])
        runner.reset(np.zeros(2))
        return runner.rollout(np.array(rows))
