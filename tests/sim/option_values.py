"""Values of every option of a Runner, to try the promises that hold for all of them."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import UnionType
from typing import Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from thermal import Thermal
from tiny_urdf import INERTIAL, joint, link, robot, write

import batchpid as bp
from batchpid.sim import MujocoSolver, OperationalSpace, Physics, Randomization, Robot, Uniform
from batchpid.sim.options.options import RunnerKeywords


def label(value):
    """Return a name of a case without addresses and temporary folders, so that it is the same in
    every process.
    """
    return re.sub(r" at 0x[0-9a-f]+|path='[^']*'", "", str(value))


def arm(mass, **options):
    """Arm of two joints, with shapes."""
    inertial = INERTIAL.replace('mass value="1"', f'mass value="{mass}"')
    ends = joint("shoulder", "base", "arm"), joint("elbow", "arm", "hand")
    with TemporaryDirectory() as folder:
        parts = link("base"), link("arm", inertial + SHAPE), link("hand", INERTIAL + SHAPE), *ends
        return Robot.load(write(Path(folder), robot(*parts)), **options)


SHAPE = '<collision><geometry><box size="0.05 0.05 0.4"/></geometry></collision>'
ARM, HEAVY = arm(1), arm(2)
MOTORS = bp.make_actuators(2, coulomb=0.3, armature=0.05)
SIGNALS = {"command_delay": 2e-3, "lag": 1e-3, "strength": 0.9, "bias": 0.1, "effort_limit": 6.0}
SENSORS = {
    "sensor_delay": 1e-3,
    "position_offset": 0.01,
    "backlash": 1e-3,
    "position_resolution": 1e-4,
}
NOISE = {"position_noise": 1e-5, "velocity_noise": 1e-3}
LINE = {
    "saturation_effort": 8.0,
    "no_load_speed": 3.0,
}
FRICTION = {
    "coulomb": 0.2,
    "static": 0.3,
    "stribeck": 0.05,
    "load_friction": 0.05,
    "viscous": 0.1,
    "armature": 0.02,
}
"""Effects of motors and sensors."""


@dataclass
class Law:
    """Controller of the caller's own."""

    kp: float = 20.0

    @property
    def version(self):
        return self.kp

    def init(self, robot, num_envs, timestep):
        return None

    def __call__(self, state, setpoint, qpos, qvel, passive):
        return None, self.kp * np.tanh(setpoint - qpos) - 5.0 * qvel + passive


def tool(name="hand", **options):
    """Controller of one axis of a link, which leaves a joint to the posture."""
    return OperationalSpace(ARM, name, axes=[True] + [False] * 5, **options)


def box(size, scene, env):
    import sapien

    builder = scene.create_actor_builder()
    builder.add_box_collision(half_size=[size, size, size])
    entity = builder.build(name="box")
    entity.set_pose(sapien.Pose([2, env, 0.15]))
    return [entity]


def box_of(size):
    def build(scene, env):
        return box(size, scene, env)

    build.version = size
    return build


VALUES = {
    "robot": [ARM, HEAVY, replace(ARM, actuators=MOTORS), arm(1, dissipation="sapien"), arm(1, self_collision="none")],
    "num_envs": [2, 3],
    "params": [ARM.params(kp=9.0, ki=None, kd=2.0), ARM.params(kp=90.0, ki=1.0, kd=9.0)],
    "first_env": [0, 5],
    "workers": [0, 1],
    "timestep": [1 / 2000, 1 / 1000],
    "substeps": [20, 7],
    "control": [
        Law(), Law(30.0), tool(), tool(damping_ratio=0.1), tool(stiffness=9.0), tool("arm"),
        tool(point=[0.3, 0, 0.1]), tool(posture=[0.1, 0.1]),
    ],
    "tool": ["arm", "hand"],
    "physics": [MujocoSolver(iterations=3), Physics("PGS", 3)],
    "build": [box_of(0.05), box_of(0.1)],
    "actuators": [bp.Actuators(), MOTORS, bp.make_actuators(2, command_delay=2e-3)],
    "randomization": [Randomization(payload=Uniform(0, 1)), Randomization(payload=Uniform(0, 2))],
    "guard": [bp.make_guard(2, rate=0.5), bp.make_guard(2, rate=0.2)],
    "plan": [bp.make_plan(2, period=0.02, horizon=4), bp.make_plan(2, period=0.03, horizon=4)],
    "stages": [[Thermal(2.0, 0.02)], [Thermal(3.0, 0.02)]],
    "contacts": [["hand"], ["arm", "hand"]],
    "wrenches": [["hand"], ["arm"]],
    "timeout": [60.0, 30.0],
}  # fmt: skip
"""Values of options to try, besides those that their types list."""

TYPES = get_type_hints(RunnerKeywords)
DECLARED = {
    name: hint.__metadata__[-1]
    for name, hint in get_type_hints(RunnerKeywords, include_extras=True).items()
}
"""Where each option is kept and shown."""


def option_values(name):
    """Return the values of an option to try: the values that its type lists, and its row of
    VALUES.
    """
    return [*listed(TYPES.get(name)), *VALUES.get(name, [])]


def listed(kind):
    """Return the values that a type lists: of a Literal, of bool, and None."""
    if kind in (bool, type(None)):
        return [True, False] if kind is bool else [None]
    if get_origin(kind) is Literal:
        return [*get_args(kind)]
    return (
        [each for part in get_args(kind) for each in listed(part)]
        if get_origin(kind) in (Union, UnionType)
        else []
    )


def is_slow(name, value):
    """Return whether a value needs compilations or processes."""
    return (
        value == "jax"
        if name == "backend"
        else name in ("workers", "cluster") and value not in (0, None)
    )
