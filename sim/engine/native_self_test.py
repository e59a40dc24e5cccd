"""Self-test of the native extensions, in a separate process: a result that differs from Python's is a failure.

Programs, and calls into SAPIEN where it is installed, are compared bit by bit. The dynamics of many robots are compared
with NumPy's, which rounds differently, within a tolerance.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

from batchpid.native.availability import first_difference
from batchpid.sim.engine.scene_spec import SceneSpec
from batchpid.sim.robot.parts import Joint

_BODY = """<inertial><mass value="1.5"/>
<inertia ixx="0.02" ixy="0.001" ixz="0" iyy="0.03" iyz="0" izz="0.01"/></inertial>
<collision><geometry><box size="0.1 0.1 0.4"/></geometry></collision>"""
_URDF = f"""<robot name="test"><link name="base"/><link name="arm">{_BODY}</link><link name="hand">{_BODY}</link>
<joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.25"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="100" velocity="9"/></joint>
<joint name="slide" type="prismatic"><parent link="arm"/><child link="hand"/><origin xyz="0 0 0.5"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="100" velocity="9"/></joint></robot>"""


def main() -> None:
    """Compare the results of the extensions with Python's; raise an error if they differ.

    This process uses the extensions without a test, since their fingerprint is in its environment.
    """
    _compare_programs()
    if find_spec("sapien"):
        import_module("batchpid.sim.engine.sapien.self_test").main()


def _compare_programs() -> None:
    """Compare programs of all operations with NumPy."""
    if problem := first_difference():
        raise AssertionError(problem)


def spec_of_two_joints() -> SceneSpec:
    """Return an arm of two joints, without the settings of a solver."""
    joints = (Joint("turn", "revolute", "base", "arm"), Joint("slide", "prismatic", "arm", "hand"))
    return SceneSpec(_URDF, (), joints, 1e-2, None)
