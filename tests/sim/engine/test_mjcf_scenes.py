"""Scenes of MJCF files in MuJoCo: all that a file holds moves as the file says, and belongs to the
state of an env.
"""

import dataclasses
import os

import mujoco
import numpy as np
import pytest

from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.sim import FaultWarning, Randomization, Robot, Runner, Uniform
from batchpid.sim.engine.mujoco.model_builder import robot_model
from batchpid.sim.engine.mujoco.mujoco_pack import ENGINE
from batchpid.sim.engine.scene_spec import SOLVERS, SceneSpec, Variation
from batchpid.sim.randomization.distributions import nominal_values
from batchpid.sim.robot.robot_options import describe

pytestmark = pytest.mark.filterwarnings(
    "ignore::batchpid.sim.StabilityWarning", "ignore:.*setpoint.*limits"
)

OPTION = (
    '<option timestep="0.0005" cone="elliptic" iterations="100" tolerance="1e-8"/><compiler'
    ' angle="radian"/>'
)
BAR = '<geom type="capsule" fromto="0 0 0 {}" size=".01" contype="0" conaffinity="0"/>'
FOUR_BAR = f"""
<mujoco model="four_bar">{OPTION}
  <worldbody>
    <body name="crank" pos="0 0 1"><joint name="crank" axis="0 1 0" damping=".02" armature=".001"/>
      {BAR.format("0 0 .1")}
      <body name="coupler" pos="0 0 .1"><joint name="pin" axis="0 1 0" stiffness=".2" springref=".3"/>
        {BAR.format(".3 0 .1")}</body></body>
    <body name="rocker" pos=".3 0 1"><joint name="rocker" axis="0 1 0"/>{BAR.format("0 0 .2")}</body>
  </worldbody>
  <equality><connect name="loop" body1="coupler" body2="rocker" anchor=".3 0 .1"/></equality>
  <actuator><motor joint="crank"/></actuator>
</mujoco>"""
FINGER = """<body name="finger{0}" pos="0 {0}.04 0"><joint name="finger{0}" type="slide" axis="0 {0}1 0" range="0 .04"
  armature=".01" damping="{1}"/><geom type="box" size=".01 .005 .03"/></body>"""
GRIPPER = f"""
<mujoco model="gripper">{OPTION}
  <worldbody>
    <body name="wrist" pos="0 0 1"><joint name="wrist" axis="1 0 0" damping=".1" frictionloss="0"/>
      <geom type="box" size=".05 .05 .02" pos="0 0 -.06"/>{FINGER.format("-", 2)}{FINGER.format("", 3)}</body>
  </worldbody>
  <equality><joint joint1="finger" joint2="finger-" polycoef="0 1 0 0 0"/></equality>
  <tendon><fixed name="grasp" stiffness="30" damping="1" springlength=".02" range="0 .07" limited="true">
    <joint joint="finger" coef="1"/><joint joint="finger-" coef="1"/></fixed></tendon>
  <actuator><motor tendon="grasp"/><motor joint="wrist"/></actuator>
</mujoco>"""
LINK = '<geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/>'
ARM = f"""
<mujoco model="arm">{OPTION}
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="post"><geom type="cylinder" size=".03 .04" pos="0 0 .04"/>
      <body name="upper" pos="0 0 .11"><joint name="turn" axis="0 0 1" damping=".5"/><joint name="lift" axis="0 1 0"/>
        {LINK}
        <body name="fore" pos=".2 0 0"><joint name="bend" axis="0 0 1" damping=".2" range="-2 2"/>{LINK}</body>
      </body></body>
    <body name="cube" pos=".3 .1 .05"><freejoint/><geom type="box" size=".04 .04 .04" density="200"/></body>
    <body name="lamp" pos="-1 0 1"><joint type="ball"/><geom size=".05" pos="0 0 -.1"/></body>
    <body name="chest" pos="0 1 .06"><freejoint/><geom type="box" size=".05 .05 .05"/>
      <body name="lid" pos="0 0 .06"><joint name="lid" axis="1 0 0" pos="0 .05 0"/>
        <geom type="box" size=".05 .05 .005"/></body></body>
  </worldbody>
  <actuator><motor joint="turn"/><motor joint="lift"/><motor joint="bend"/></actuator>
  <keyframe><key name="home" qpos="0 0 .2 .3 .09 .05 1 0 0 0 1 0 0 0 0 1 .06 1 0 0 0 .2"/></keyframe>
</mujoco>"""
CLOTH = (
    ARM.replace("<keyframe>", "<!--")
    .replace("</keyframe>", "-->")
    .replace(
        "</worldbody>",
        """<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" radius=".01" dim="2"
          pos=".3 .1 .3" mass=".1">
      <edge equality="true"/></flexcomp></worldbody>""",
    )
)
TEXTS = {"four-bar": FOUR_BAR, "gripper": GRIPPER, "arm": ARM, "cloth": CLOTH}
OBJECTS = ("cube", "lamp", "chest", "lid")


@pytest.fixture
def load(tmp_path):
    """Function that loads the robot of an MJCF text."""

    def load(text, **options):
        path = tmp_path / "scene.xml"
        path.write_text(text)
        return Robot.load(path, **options)

    return load


def efforts(robot, ticks, scale=0.3):
    """Return efforts (ticks, dof) on the actuated, independent joints, exact in float32."""
    rows = np.zeros((ticks, robot.dof))
    names = {"crank": 0.05, "finger-": 4.0, "wrist": 0.6, "turn": 0.4, "lift": -0.3, "bend": -0.3}
    for joint, name in enumerate(robot.joint_names):
        rows[:, joint] = names.get(name, 0.0) * np.sin(0.3 * np.arange(ticks) + joint)
    return rows.astype(np.float32).astype(float)


def in_mujoco(robot, model, rows, substeps):
    """Return the poses of all bodies (ticks, bodies, 7) in MuJoCo's own steps of a model, from its
    start.
    """
    data, poses = mujoco.MjData(model), []
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    for row in rows:
        for name, effort in zip(robot.joint_names, row, strict=True):
            data.qfrc_applied[model.joint(name).dofadr] = effort
        for _ in range(substeps):
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        poses.append(np.hstack([data.xpos, data.xquat]))
    return np.array(poses)


def run(runner, rows):
    """Return the poses of the file's bodies (ticks, envs, bodies, 7) under setpoints (ticks,
    dof).
    """
    poses = []
    for row in rows:
        runner.step(row)
        poses.append(runner.bodies(runner.robot.mjcf.bodies))
    return np.array(poses)


@pytest.mark.parametrize("name", TEXTS)
def test_moves_as_the_file_says(load, name):
    robot = load(TEXTS[name], self_collision="urdf")
    rows, model = efforts(robot, 40), mujoco.MjModel.from_xml_string(TEXTS[name])
    with Runner(
        robot, 2, workers=0, engine="mujoco", control="effort", compensate="none", substeps=10
    ) as runner:
        ours = run(runner, rows)
    theirs = in_mujoco(robot, model, rows, 10)
    assert np.ptp(theirs, axis=0).max() > 0.03
    np.testing.assert_allclose(
        ours, np.broadcast_to(theirs[:, None], ours.shape), rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("control", ["pid", "drive"])
def test_the_law_drives_the_joints_and_the_arm_pushes_the_cube(load, control):
    robot = load(ARM)
    assert robot.joint_names == ("turn", "lift", "bend")
    with Runner(robot, 1, workers=0, engine="mujoco", control=control) as runner:
        before = runner.bodies(["cube"])
        for _ in range(200):
            obs = runner.step([0.5, 0.1, 0.0])
        after = runner.bodies(["cube"])
    assert np.abs(obs.qpos - [0.5, 0.1, 0.0]).max() < (
        0.05 if control == "pid" else 0.1
    )  # a drive has no integral
    assert np.linalg.norm((after - before)[0, 0, :2]) > 0.01


def test_an_object_that_diverges_is_a_fault_of_its_env(load):
    text = (
        ARM.replace("<keyframe>", "<!--")
        .replace("</keyframe>", "-->")
        .replace('density="200"/>', 'density="200"/><site name="c"/>')
    )
    spring = '<tendon><spatial stiffness="1e14"><site site="c"/><site site="w"/></spatial></tendon>'
    text = text.replace("</worldbody>", f'<site name="w" pos="0 0 3"/></worldbody>{spring}')
    with Runner(load(text), 1, workers=0, engine="mujoco") as runner:
        with pytest.warns(FaultWarning):
            obs = runner.step(runner.robot.start)
        assert not obs.ok.any()
        assert runner.faults[0].cause == "state"
        np.testing.assert_array_equal(runner.bodies(OBJECTS)[0, 0, :2], [0.3, 0.1])  # at its start


def test_a_closed_loop_has_no_tree(load):
    robot = load(FOUR_BAR)
    options = {"num_envs": 1, "workers": 0, "engine": "mujoco"}
    with pytest.raises(InvalidArgumentError, match=r"^control.*'loop'"):
        Runner(robot, **options, control="osc")
    with pytest.raises(InvalidArgumentError, match=r"gain_units.*'loop'"):
        Runner(robot, params=robot.designed(), **options)
    with Runner(robot, **options) as runner:  # its default gains need no tree
        assert runner.params.gain_units is None
        for _ in range(50):
            obs = runner.step(np.zeros(3))
        poses = dict(
            zip(("coupler", "rocker"), runner.bodies(["coupler", "rocker"])[0], strict=True)
        )
    assert obs.ok.all()
    ends = []
    for name, end in (("coupler", [0.3, 0, 0.1]), ("rocker", [0.0, 0, 0.2])):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, poses[name][3:])
        ends.append(poses[name][:3] + matrix.reshape(3, 3) @ end)
    np.testing.assert_allclose(*ends, atol=2e-3)


def test_what_a_scene_does_not_have_is_refused(load):
    robot = load(ARM)
    with pytest.raises(InvalidArgumentError, match=r"collisions.*cube, chest"):
        Runner(robot, 1, workers=0, engine="mujoco", collisions=False)
    with (
        Runner(robot, 1, workers=0, engine="mujoco") as runner,
        pytest.raises(InvalidArgumentError, match="'ball'"),
    ):
        runner.bodies(["ball"])
    with (
        Runner(load(GRIPPER), 1, workers=0, engine="sapien") as runner,
        pytest.raises(InvalidArgumentError, match="names"),
    ):
        runner.bodies(["wrist"])
    with Runner(robot, 1, workers=0, engine="mujoco") as runner:
        kept = runner.snapshot()
    robot = load(ARM.replace('density="200"', 'density="100"'))
    with (
        Runner(robot, 1, workers=0, engine="mujoco") as runner,
        pytest.raises(InvalidArgumentError, match="another mjcf"),
    ):
        runner.restore(kept)
    robot = load(ARM.replace('density="200"', 'density="150"'))
    robot.path.write_text(ARM)
    with pytest.raises(RobotError, match="has changed since the robot was loaded"):
        Runner(robot, 1, workers=0, engine="mujoco")


@pytest.mark.parametrize("wrenches", [None, ["tip"]])
def test_masses_and_damping_vary(load, wrenches):
    """A randomized robot moves as the file with other numbers, also where several bodies are one
    link.
    """
    tip = (
        '<body name="tip" pos=".2 0 0" quat=".9 .1 .3 0"><inertial pos=".01 0 .02" mass="{}"'
        ' diaginertia="{}"/></body>'
    )
    arm = ARM.replace(f"{LINK}</body>", f"{LINK}{{}}</body>")
    robot = load(arm.format(tip.format(0.2, "1e-4 2e-4 2.5e-4")))
    heavy = arm.format(tip.format(0.4, "2e-4 4e-4 5e-4")).replace('damping=".5"', 'damping="1"')
    model = mujoco.MjModel.from_xml_string(heavy.replace('damping=".2"', 'damping=".4"'))
    twice = Uniform(2.0, 2.0, operation="scale")
    varied = Randomization(link_mass={"tip": twice}, damping=twice)
    rows = efforts(
        robot, 15
    )  # without contacts, whose softness in MuJoCo depends on how mass is divided among bodies
    options = {"control": "effort", "compensate": "none", "substeps": 10, "randomization": varied}
    with Runner(robot, 2, workers=0, engine="mujoco", wrenches=wrenches, **options) as runner:
        ours = run(runner, rows)
    theirs = in_mujoco(robot, model, rows, 10)
    np.testing.assert_allclose(
        ours, np.broadcast_to(theirs[:, None], ours.shape), rtol=0, atol=1e-8
    )


WALKER = """
<mujoco><worldbody>
  <body name="ball" pos="3 0 .1"><freejoint/><geom size=".1"/></body>
  <body name="trunk" pos="0 0 .5" quat="1 1 0 0"><freejoint/><geom type="box" size=".1 .1 .1"/>
    <body name="leg" pos="0 0 .2"><joint name="hip" axis="0 1 0"/><geom type="box" size=".02 .02 .1"/></body></body>
</worldbody><actuator><motor joint="hip"/></actuator></mujoco>"""


def test_a_floating_base_behind_an_object(load):
    """Pose and twist of a base are those of its link, wherever MuJoCo has them, and in both engines
    the same.
    """
    robot = load(WALKER, fixed_base=False)
    pose, twist = [0.1, 0.2, 3.0, 0.8, 0.0, 0.6, 0.0], [0.3, 0.1, 0.2, 1.0, 2.0, 3.0]
    seen = []
    cases = (
        ("mujoco", "none"),
        ("sapien", "none"),
        ("mujoco", "gravity+coriolis"),
        ("rebuilt", "gravity+coriolis"),
    )
    for engine, compensate in cases:
        options = {
            "engine": "sapien" if engine == "sapien" else "mujoco",
            "compensate": compensate,
            "ground": False,
        }
        source = robot.source._replace(mjcf=None)
        shown = dataclasses.replace(robot, source=source) if engine == "rebuilt" else robot
        with Runner(shown, 1, workers=0, control="effort", **options) as runner:
            obs = runner.reset(base_pose=pose, base_twist=twist)
            np.testing.assert_allclose(obs.base_pose[0], pose, atol=1e-6)
            np.testing.assert_allclose(obs.base_twist[0], twist, atol=1e-5)
            if engine == "mujoco":
                np.testing.assert_allclose(runner.bodies(["trunk"])[0, 0], pose)
            for _ in range(20):
                obs = runner.step([0.02])
            seen.append(np.concatenate([obs.qpos[0], obs.base_pose[0], obs.base_twist[0]]))
    np.testing.assert_allclose(*seen[:2], atol=1e-3)
    np.testing.assert_allclose(*seen[2:], atol=1e-5)
    assert np.abs(seen[0] - seen[2]).max() > 0.01


def test_gains_of_the_law_are_those_of_the_user(load):
    """The file's own servos do nothing."""
    servo = ARM.replace('<motor joint="turn"/>', '<position joint="turn" kp="1000"/>')
    robot, poses = load(servo), []
    with Runner(
        robot, 1, workers=0, engine="mujoco", params=robot.params(kp=0.0), compensate="none"
    ) as runner:
        for _ in range(5):
            runner.step([1.0, 0.2, 0.2])
        poses.append(runner.bodies(["upper"]))
    with Runner(
        load(ARM), 1, workers=0, engine="mujoco", control="effort", compensate="none"
    ) as runner:
        for _ in range(5):
            runner.step(np.zeros(3))
        poses.append(runner.bodies(["upper"]))
    np.testing.assert_array_equal(*poses)


def test_the_planes_of_the_file_are_the_ground(load):
    """A floor below an arm that reaches under height 0 stays, and the runner's ground stands in for
    a missing one.
    """
    low = ARM.replace('type="plane"', 'type="plane" pos="0 0 -.5"').replace(
        '<body name="post">', '<body name="post" pos="0 0 -.2">'
    )
    # A <pair> collides whatever the masks say.
    paired = low.replace('name="floor"', 'name="floor" contype="0" conaffinity="0"')
    paired = paired.replace('size=".04 .04 .04"', 'name="box" size=".04 .04 .04"')
    pair = '<contact><pair geom1="floor" geom2="box"/></contact></mujoco>'
    paired = paired.replace("</mujoco>", pair)
    heights = {}
    for name, text, options in (
        ("file", low, {}),
        ("off", low, {"ground": False}),
        ("ours", ARM, {}),
        ("paired", paired, {}),
        ("paired off", paired, {"ground": False}),
    ):
        text = (
            text
            if name != "ours"
            else text.replace('<geom name="floor" type="plane" size="1 1 .1"/>', "")
        )
        with Runner(load(text), 1, workers=0, engine="mujoco", **options) as runner:
            for _ in range(100):
                runner.step(runner.robot.start)
            heights[name] = runner.bodies(["cube"])[0, 0, 2]
    np.testing.assert_allclose((heights["file"], heights["ours"]), (-0.46, 0.04), atol=2e-3)
    np.testing.assert_allclose(heights["paired"], heights["file"], atol=2e-3)
    assert max(heights["off"], heights["paired off"]) < -3


def test_an_error_of_mujoco_closes_the_runner(load):
    # Enough to load the robot, and not for its contacts.
    robot = load(ARM.replace("<worldbody>", '<size memory="20K"/><worldbody>', 1))
    with Runner(robot, 2, workers=0, engine="mujoco", control="effort") as runner:
        with pytest.raises(Exception, match="memory"):
            runner.rollout(np.full((100, 2, robot.dof), 3.0))
        assert runner.closed


def random_file(rng):
    """Return an MJCF text of an arm with up to three joints a body that falls onto its floor."""
    flag = rng.choice(
        [
            "",
            '<flag contact="disable"/>',
            '<flag override="enable"/>',
            '<flag filterparent="disable"/>',
        ]
    )
    option = OPTION.replace(
        "/>", f' o_margin=".05" o_solref=".02 1" o_solimp=".9 .95 .001 .5 2">{flag}</option>', 1
    )
    margin = rng.choice(["", 'margin=".03" gap=".01"'], p=[0.8, 0.2])
    bodies, count = "", 0
    for number in range(3):
        joints = ""
        for _ in range(rng.integers(number == 0, 4)):
            axis, slides = " ".join(map(str, rng.normal(size=3).round(2))), rng.random() < 0.4
            kind = (
                'type="slide" range="-.1 .1"'
                if slides
                else f'type="hinge" pos="{rng.choice([0, -0.2])} 0 0"'
            )
            ref = rng.choice([0, 0.3, 2])
            joints += (
                f'<joint name="j{count}" {kind} axis="{axis}" ref="{ref}"'
                f' damping="{20 if slides else 0.02}"/>'
            )
            count += 1
        place = "0 0 .3" if number == 0 else ".25 0 0"
        bodies += (
            f'<body pos="{place}">{joints}<geom type="capsule" size=".04" fromto="0 0 0 .2 0 0"'
            f" {margin}/>"
        )
    world = f"<worldbody><geom type='plane' size='1 1 1'/>{bodies}{3 * '</body>'}</worldbody>"
    return (
        f"<mujoco>{option}{world}<keyframe><key name='home'"
        f" qpos='{count * '0 '}'/></keyframe></mujoco>"
    )


@pytest.mark.parametrize("seed", range(16))
def test_random_files_in_contact_move_as_in_mujoco(load, monkeypatch, seed):
    rng = np.random.default_rng(seed)
    text, collides = random_file(rng), bool(rng.random() < 0.8)
    robot, model = load(text, self_collision="urdf"), mujoco.MjModel.from_xml_string(text)
    if not collides:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    rows, seen = np.zeros((80, robot.dof)), []
    for native in (1, 0):
        monkeypatch.setenv("BATCHPID_NATIVE", str(native))
        options = {
            "control": "effort",
            "compensate": "none",
            "substeps": 20,
            "collisions": collides,
        }
        with Runner(robot, 1, workers=0, engine="mujoco", **options) as runner:
            seen.append(run(runner, rows)[:, 0])
    np.testing.assert_array_equal(*seen)
    np.testing.assert_allclose(seen[0], in_mujoco(robot, model, rows, 20), rtol=0, atol=1e-6)


BLOCK = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
OPENED = {
    "scene.xml": (
        """<mujoco><compiler meshdir="parts"/><asset><mesh name="block" file="block.obj"/>
      <hfield name="hills" file="hills.bin" size="1 1 .1 .1"/><model name="other" file="other.xml"/></asset>
      <worldbody><geom type="hfield" hfield="hills" pos="2 0 0"/><include file="arm.xml"/>
      <frame pos="0 3 0"><attach model="other" body="pole" prefix="b"/></frame></worldbody></mujoco>"""
    ),
    "arm.xml": (
        """<mujocoinclude><body name="arm"><joint name="j" axis="0 1 0"/>
      <geom size=".1 .1 .1" type="box"/></body>
      <body name="toy" pos="1 0 1"><freejoint/><geom type="mesh" mesh="block"/></body></mujocoinclude>"""
    ),
    "other.xml": (
        """<mujoco><asset><mesh name="tip" file="tip.obj"/></asset><worldbody>
      <body name="pole"><geom size=".1"/><geom type="mesh" mesh="tip"/></body></worldbody></mujoco>"""
    ),
    "parts/block.obj": BLOCK,
    "tip.obj": BLOCK,
    "parts/hills.bin": (
        np.array([2, 2], np.int32).tobytes() + np.array([0, 0.1, 0.2, 0.3], np.float32).tobytes()
    ),
}


@pytest.mark.parametrize("changed", OPENED)
def test_every_file_that_a_load_opens_is_part_of_the_identity(tmp_path, changed):
    (tmp_path / "parts").mkdir()
    for name, content in OPENED.items():
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    robot = Robot.load(tmp_path / "scene.xml")
    with Runner(robot, 1, workers=0, engine="mujoco"):
        pass
    path = tmp_path / changed
    stamp = path.stat().st_mtime_ns
    path.write_bytes(
        path.read_bytes()
        .replace(b".1", b".2")
        .replace(*(np.float32(x).tobytes() for x in (0.3, 0.5)))
    )
    os.utime(path, ns=(stamp, stamp))  # by which MuJoCo keeps meshes
    assert describe(Robot.load(tmp_path / "scene.xml")) != describe(robot)
    robot_model.cache_clear()
    with pytest.raises(RobotError, match="has changed since the robot was loaded"):
        Runner(robot, 1, workers=0, engine="mujoco")


STARTS = {
    "plane": ('<geom type="plane" size="5 5 1" pos="0 0 .5"/>', "0 0 1 1 0 0 0", 0.55),
    "low plane": ('<geom type="plane" size="5 5 1" pos="0 0 -1"/>', "0 0 -.5 1 0 0 0", -0.95),
    "platform": ('<geom type="box" size="1 1 .2" pos="0 0 .2"/>', "0 0 .6 1 0 0 0", 0.45),
    "turned": ('<geom type="plane" size="5 5 1"/>', "1 2 .3 0 1 0 0", 0.25),
}


@pytest.mark.parametrize("keyed", [True, False])
@pytest.mark.parametrize("name", STARTS)
def test_a_floating_robot_starts_where_its_file_places_its_root_body(load, name, keyed):
    ground, pose, height = STARTS[name]
    values = pose.split()
    place = "" if keyed else f'pos="{" ".join(values[:3])}" quat="{" ".join(values[3:])}"'
    key = f'<keyframe><key name="home" qpos="{pose} 0"/></keyframe>' if keyed else ""
    body = (
        f'<body name="t" {place}><freejoint/><geom type="box" size=".2 .2 .05" mass="5"/><body'
        ' name="l" pos="0 0 .2">'
    )
    leg = '<joint name="a" axis="0 1 0" range="-1 1" damping="1"/><geom size=".05" mass=".1"/>'
    text = f"<mujoco>{OPTION}<worldbody>{ground}{body}{leg}</body></body></worldbody>{key}</mujoco>"
    robot = load(text, fixed_base=False)
    assert [*robot.tables.links] == ["t", "l"]
    for engine in ("mujoco", "sapien"):
        with Runner(robot, 1, workers=0, engine=engine, physics="accurate") as runner:
            start = runner.observe().base_pose[0]
            if engine == "mujoco" or name != "low plane":  # SAPIEN's ground is at height 0
                np.testing.assert_allclose(start, [float(each) for each in values], atol=1e-6)
            if engine == "mujoco":
                for _ in range(100):
                    seen = runner.step(robot.start)
                np.testing.assert_allclose(seen.base_pose[0, 2], height, atol=2e-3)
            seen = runner.reset(base_pose=start, base_twist=[0, 0, 0.1, 0, 0.2, 0])
            np.testing.assert_allclose(seen.base_pose[0], start, atol=1e-6)
            np.testing.assert_allclose(seen.base_twist[0], [0, 0, 0.1, 0, 0.2, 0], atol=1e-6)


BOX = '<geom type="box" size=".2 .2 .05" mass="5" contype="{0}" conaffinity="{0}"/>'
DEFAULTS = {
    "none": ("", 1),
    "masks": ('contype="0" conaffinity="0"', 1),
    "other masks": ("", 2),
    "material": ('material="m"', 1),
    "contact": ('margin=".2" condim="1" friction="0" solref=".1 1"', 1),
}


@pytest.mark.parametrize("name", DEFAULTS)
def test_the_ground_that_is_added_is_not_of_the_files_default_class(load, name):
    default, mask = DEFAULTS[name]
    body = (
        '<body name="t" pos="0 0'
        f' .1"><freejoint/>{BOX.format(mask).replace("/>", " {}/>")}{{}}</body>'
    )
    own = 'margin="0" condim="3" friction="1 .005 .0001" solref=".02 1"'
    geom = '<geom size=".05" contype="0" conaffinity="0"/>'
    leg = f'<body pos="0 0 .2"><joint name="a" axis="0 1 0" range="-1 1"/>{geom}</body>'
    head = f'<default><geom {default}/></default><asset><material name="m"/></asset>'
    text = f"<mujoco>{head}<worldbody>{body.format(own, leg)}</worldbody></mujoco>"
    with Runner(load(text, fixed_base=False), 1, workers=0, engine="mujoco") as runner:
        for _ in range(100):
            seen = runner.step([0.0])
    np.testing.assert_allclose(seen.base_pose[0], [0, 0, 0.05, 1, 0, 0, 0], atol=1e-3)


def test_a_sleep_policy_has_no_effect(load):
    text = WALKER.replace('<body name="trunk"', '<body name="trunk" sleep="init"')
    for fixed in (True, False):
        with Runner(load(text, fixed_base=fixed), 1, workers=0, engine="mujoco") as runner:
            assert runner.step([0.02]).qpos[0, 0] != 0


def test_a_link_between_two_joints_of_a_body_has_no_sensor_and_no_payload(load):
    robot = load(ARM)
    (between,) = {link.name for link in robot.tables.bodies} - {*robot.mjcf.bodies}
    payload = Randomization(payload=Uniform(0.1, 0.2), payload_link=between)
    for options in ({"contacts": [between]}, {"wrenches": [between]}, {"randomization": payload}):
        with pytest.raises(RobotError, match=f"'{between}' lies between two joints of one body"):
            Runner(robot, 1, workers=0, engine="mujoco", **options)


@pytest.mark.parametrize(
    ("draw", "ground", "arm"),
    [
        (Uniform(0.0, 0.0), 0.8, 0.4),
        (Uniform(0.5, 0.5, operation="scale"), 0.4, 0.2),
        (Uniform(0.2, 0.2, operation="abs"), 0.2, 0.1),
        (Uniform(-0.6, -0.6), 0.2, 0.1),
    ],
)
def test_ground_friction_is_drawn_around_that_of_the_file(load, draw, ground, arm):
    text = ARM.replace(LINK, LINK[:-2] + ' friction=".4"/>')
    robot = load(text.replace('type="plane"', 'type="plane" friction=".8"'))
    spec = SceneSpec(robot.tables, (), robot.joints, 1e-3, SOLVERS["accurate"], mjcf=robot.mjcf)
    nominal = nominal_values("ground_friction", robot, robot.mjcf)
    pack = ENGINE.make_pack(
        spec, 1, variation=Variation(ground_friction=draw.apply(nominal, draw.low))
    )
    (model,) = pack.models
    bodies = [model.body(body).name for body in model.geom_bodyid]
    friction = dict(zip(bodies, model.geom_friction[:, 0], strict=True))
    expected = {"world": ground, "fore": arm, "cube": 1.0, "lid": 1.0}
    assert {name: friction[name] for name in expected} == pytest.approx(expected)


def test_no_log_file_is_written(tmp_path, monkeypatch, capfd):
    """Not by a worker, either, where MuJoCo warns of a small memory."""
    boxes = "".join(f'<body pos="{x} 0 .04"><freejoint/>{BOX.format(1)}</body>' for x in range(8))
    arm = '<body pos="0 0 1"><joint name="j" axis="0 1 0"/><geom size=".1"/></body>'
    text = (
        '<mujoco><size memory="30K"/><worldbody><geom type="plane" size="1 1'
        f' 1"/>{boxes}{arm}</worldbody></mujoco>'
    )
    (tmp_path / "scene.xml").write_text(text)
    monkeypatch.chdir(tmp_path)
    with Runner(Robot.load("scene.xml"), 1, workers=1, engine="mujoco") as runner:
        runner.step([0.0])
    assert "MuJoCo: Insufficient arena memory" in capfd.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]
