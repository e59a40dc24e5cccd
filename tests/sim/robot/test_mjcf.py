"""MJCF files: the robot that is simulated is the one that MuJoCo compiles, and whatever is not has
a finding.
"""

import random
import re
from contextlib import suppress
from itertools import combinations

import mujoco
import numpy as np
import pytest

from batchpid.errors import RobotError
from batchpid.sim import Robot, Runner
from batchpid.sim.engine.mujoco.model_builder import robot_model
from batchpid.sim.engine.protocol import SceneSpec
from batchpid.sim.engine.scene_spec import SOLVERS
from batchpid.sim.robot.robot_options import describe
from batchpid.sim.view.scene import surfaces

pytestmark = pytest.mark.filterwarnings("ignore::batchpid.sim.StabilityWarning")

WEDGE = '<mesh name="wedge" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .2  .02 .02 .02"/>'
ARM = f"""
<mujoco model="arm">
  <compiler angle="radian"/>
  <asset>{WEDGE}</asset>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body name="base" pos="0 0 2" quat=".9 .1 .3 -.2">
      <geom type="cylinder" size=".05 .1"/>
      <body name="upper" pos="0 0 .1">
        <joint name="lift" axis="0 1 0" pos=".02 0 -.03" ref=".4" range="-1 2" damping=".3" armature=".02"/>
        <geom name="limb" type="capsule" fromto="0 0 0 .3 0 .1" size=".03"/>
        <geom type="sphere" size=".5" contype="0" conaffinity="0" mass=".2"/>
        <body name="fore" pos=".3 0 .1" quat=".9 .1 .2 .3">
          <joint name="reach" type="slide" axis="1 0 1" ref=".05" range="-.1 .2" frictionloss=".1"/>
          <geom type="mesh" mesh="wedge" pos=".1 0 0"/>
          <body name="flange" pos=".2 0 0"><geom type="box" size=".02 .03 .04" quat=".5 .1 0 0"/>
            <body name="hand" pos="0 0 .1">
              <joint name="turn" axis="0 0 1" pos="0 .01 0"/>
              <inertial pos=".01 0 .02" mass=".3" fullinertia=".002 .003 .004 .0001 .0002 .0003"/>
              <geom type="ellipsoid" size=".02 .03 .05"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="base" body2="fore"/></contact>
  <actuator>
    <position joint="lift" kp="100" kv="7" gear="2" forcerange="-10 10"/>
    <motor joint="reach" gear="3" ctrlrange="-4 4"/>
  </actuator>
  <keyframe><key name="home" qpos=".7 .1 .2"/></keyframe>
</mujoco>"""
BOX = '<geom size=".1 .1 .1" type="box"/>'
CHAIN = f"""
<mujoco>
  <worldbody>
    <body name="cart"><joint name="x" type="slide" axis="1 0 0" ref=".2"/><joint name="y" type="slide" axis="0 1 0"/>
      <joint name="yaw" axis="0 0 1" pos=".1 .2 0" ref="30"/>{BOX}
      <body pos="0 0 .3"><joint axis="1 1 0" pos="0 0 -.1"/>{BOX}</body>
    </body>
    <body name="table" pos="1 0 0">{BOX}</body>
  </worldbody>
</mujoco>"""
LEG = (
    '<body name="leg{0}" pos="0 {0} 0"><joint name="hip{0}" axis="0 1 0" pos="0 0 .1"'
    ' armature=".1"/>{1}</body>'
)
WALKER = f"""
<mujoco>
  <worldbody>
    <body name="trunk" pos="0 0 .5" quat="1 .2 0 0"><freejoint/>{BOX}{LEG.format(1, BOX)}{LEG.format(2, BOX)}</body>
    <body name="ball" pos="3 0 0"><freejoint/>{BOX}</body>
    <body name="goal" mocap="true"/>
  </worldbody>
</mujoco>"""
TEXTS = {"arm": ARM, "chain": CHAIN, "walker": WALKER}


@pytest.fixture
def load(tmp_path):
    """Function that loads the robot of an MJCF text."""

    def load(text, **options):
        path = tmp_path / "robot.xml"
        path.write_text(text)
        return Robot.load(path, **options)

    return load


def two_links(joint='<joint name="j"/>', rest="", geom=BOX):
    return (
        f'<mujoco><worldbody><body name="a">{geom}<body name="b" pos="0 0'
        f' 1">{joint}{geom}</body></body></worldbody>{rest}</mujoco>'
    )


def spec_of(robot, **options):
    options = {
        "ground": False,
    } | options
    return SceneSpec(
        robot.tables, robot.self_contact.ignored, robot.joints, 5e-4, SOLVERS["accurate"], **options
    )


@pytest.mark.parametrize("name", TEXTS)
def test_mass_matrix_and_bias_are_those_of_the_file(load, name):
    robot = load(TEXTS[name], fixed_base=True, self_collision="none")
    model = mujoco.MjModel.from_xml_string(TEXTS[name])
    data, full = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    joints = [
        3 if each == "joint3" else model.joint(each).id for each in robot.joint_names
    ]  # that has no name
    places, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    rng = np.random.default_rng(0)
    qpos, qvel = rng.uniform(-2, 2, (2, 50, robot.dof))
    matrices, biases = [], []
    for q, v in zip(qpos, qvel, strict=True):
        data.qpos[places], data.qvel[dofs] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        matrices.append(full[np.ix_(dofs, dofs)] - np.diag(model.dof_armature[dofs]))
        biases.append(data.qfrc_bias[dofs].copy())
    massless = 1e-4 if name == "chain" else 1e-9  # links that both engines give 1e-6 kg
    bias = robot.dynamics().inverse_dynamics(qpos, qvel, np.zeros_like(qpos))
    np.testing.assert_allclose(robot.mass_matrix(qpos), matrices, atol=massless * np.max(matrices))
    np.testing.assert_allclose(bias, biases, atol=massless * np.abs(biases).max())


def test_joints_are_those_of_the_file(load):
    robot = load(ARM)
    assert (robot.name, load(CHAIN).name) == ("arm", "robot")  # of the model, else of the file
    assert robot.joint_names == ("lift", "reach", "turn")
    assert [joint.type for joint in robot.joints] == ["revolute", "prismatic", "continuous"]
    np.testing.assert_array_equal(robot.lower, [-1, -0.1, -np.inf])
    np.testing.assert_array_equal(robot.upper, [2, 0.2, np.inf])
    np.testing.assert_array_equal(robot.damping, [0.3, 0, 0])
    np.testing.assert_array_equal(robot.friction, [0, 0.1, 0])
    np.testing.assert_array_equal(robot.effort_limit, [20, 12, np.inf])
    np.testing.assert_array_equal(robot.actuators.armature, [[0.02, 0, 0]])
    np.testing.assert_array_equal(robot.start, [0.7, 0.1, 0.2])
    np.testing.assert_allclose(load(CHAIN).start, [0.2, 0, np.deg2rad(30), 0])
    assert (
        describe(robot)["settings"]
        != describe(load(ARM.replace('qpos=".7', 'qpos=".6')))["settings"]
    )


def gaps(model, places, qpos):
    """Return the distances (pairs,) [m] of the geoms that can collide, in their order."""
    data = mujoco.MjData(model)
    data.qpos[places] = qpos
    mujoco.mj_forward(model, data)
    pairs = combinations(np.flatnonzero(model.geom_contype), 2)
    return [mujoco.mj_geomDistance(model, data, *pair, 9.0, None) for pair in pairs]


def test_shapes_are_where_they_are_in_the_file(load):
    robot = load(ARM, self_collision="none")
    built = robot_model(spec_of(robot, ground=True))
    original = mujoco.MjModel.from_xml_string(ARM)
    places = [original.jnt_qposadr[original.joint(name).id] for name in robot.joint_names]
    qpos = [0.7, -0.05, 1.2]
    errors = np.abs(gaps(original, places, qpos) - np.array(gaps(built.model, built.qpos, qpos)))
    assert np.count_nonzero(errors < 1e-6) == 10
    assert errors.max() < 0.03 * 0.05  # the ellipsoid's, to the other five


def test_pairs_that_do_not_collide(load):
    def pairs(text, **options):
        return {
            frozenset((pair.first, pair.second))
            for pair in load(text, **options).self_contact.pairs
        }

    assert frozenset(("base", "fore")) in pairs(ARM, self_collision="urdf")
    masked = two_links().replace('type="box"', 'type="box" contype="2" conaffinity="4"')
    assert pairs(masked, self_collision="urdf") == {frozenset("ab")}
    assert pairs(two_links(), self_collision="urdf") == set()
    forced = masked.replace(
        "<worldbody>", '<contact><pair geom1="ga" geom2="gb"/></contact><worldbody>'
    )
    forced = forced.replace("<geom", '<geom name="ga"', 1).replace(
        'b" pos="0 0 1"><joint name="j"/><geom', 'b" pos="0 0 1"><joint name="j"/><geom name="gb"'
    )
    assert pairs(forced, self_collision="urdf") == set()


def test_an_srdf_has_the_last_word(load, tmp_path):
    (tmp_path / "robot.srdf").write_text(
        '<robot><enable_collisions link1="base" link2="fore"/></robot>'
    )
    assert load(ARM, self_collision="urdf").self_contact.ignored == ()


def test_links_of_a_split_body_keep_their_pairs(load):
    """A body whose links collide with another body in part still ignores the others whole."""
    arm = '<body name="{0}" pos="{1}"><joint name="j{0}"/><geom size=".1"/></body>'
    text = f"""<mujoco><worldbody><body name="base" pos="0 0 .01"><geom size=".1"/>
      <body name="torso"><geom size=".1"/></body>{arm.format("near", "0 0 .02")}{arm.format("far", "2 0 0")}
      </body></worldbody><contact><exclude body1="torso" body2="far"/></contact></mujoco>"""
    robot = load(text)
    built = robot_model(spec_of(robot))
    data = mujoco.MjData(built.model)
    mujoco.mj_forward(built.model, data)
    assert data.ncon == 0


def test_couplings(load):
    joints = two_links().replace('<joint name="j"/>', '<joint name="j" ref="30"/>')
    joints = joints.replace(
        "</body></body>",
        '<body name="c" pos="0 0 1"><joint name="k" armature=".1" damping=".2"/><geom'
        ' size=".1"/></body></body></body>',
    )
    text = joints.replace(
        "</mujoco>",
        '<equality><joint joint1="k" joint2="j" polycoef=".1 -2 0 0 0"/></equality></mujoco>',
    )
    robot = load(text)
    (mimic,) = [joint.mimic for joint in robot.joints if joint.mimic is not None]
    assert (mimic.joint, mimic.multiplier) == ("j", -2)
    assert mimic.offset == pytest.approx(0.1 + 2 * np.deg2rad(30))
    np.testing.assert_allclose(robot.actuators.armature, [[0.4, 0]])
    np.testing.assert_allclose(robot.damping, [0.8, 0])


def test_a_tendon_that_pulls_coupled_fingers(load):
    finger = (
        '<body name="{0}"><joint name="{0}" type="slide" axis="0 {1} 0" range="0 .04"/><geom'
        ' size=".01"/></body>'
    )
    text = f"""<mujoco><worldbody><body name="hand">{BOX}{finger.format("left", 1)}{finger.format("right", -1)}</body>
      </worldbody><tendon><fixed name="split" actuatorfrcrange="-60 60">
      <joint joint="left" coef=".5"/><joint joint="right" coef=".5"/></fixed>
      </tendon><equality><joint joint1="left" joint2="right"/></equality>
      <actuator><general tendon="split" forcerange="-100 100" ctrlrange="0 255" gainprm=".0157 0 0"
        biastype="affine" biasprm="0 -100 -10"/></actuator></mujoco>"""
    robot = load(text)
    assert robot.effort_limit[robot.joint_names.index("right")] == 60
    gains = robot.mjcf_gains()
    np.testing.assert_allclose(np.ravel(gains.kp), [0, 100])
    np.testing.assert_allclose(np.ravel(gains.kd), [0, 10])


def test_several_actuators_of_a_joint_add_up(load):
    text = two_links(
        rest="""<actuator><position joint="j" kp="5" gear="2" forcerange="-1 1"/>
        <velocity joint="j" kv="3" forcerange="-4 4"/><motor joint="j" gear="3" ctrlrange="-2 2"/></actuator>"""
    )
    robot = load(text)
    np.testing.assert_array_equal(robot.effort_limit, [12])
    np.testing.assert_array_equal(
        [np.ravel(robot.mjcf_gains().kp), np.ravel(robot.mjcf_gains().kd)], [[20], [3]]
    )


def test_the_gear_of_an_actuator_after_an_orientation_servo_is_its_own(load):
    """Of the servo's three outputs each has a gear."""
    servo = '<orientation site="s" refsite="r" kp="1"/>'
    sites = BOX + '<site name="s"/><site name="r"/>'
    text = two_links(
        rest=f'<actuator>{servo}<motor joint="j" gear="3" ctrlrange="-2 2"/></actuator>'
    )
    np.testing.assert_array_equal(load(text.replace(BOX, sites, 1)).effort_limit, [6])


def test_armature_of_an_actuator_of_coupled_joints(load):
    text = f"""<mujoco><worldbody><body name="a">{BOX}<body name="b" pos="0 0 1">
      <joint name="j"/><joint name="k"/>{BOX}</body></body></worldbody>
      <actuator><motor tendon="t" armature=".3" gear="3"/></actuator>
      <tendon><fixed name="t"><joint joint="j" coef="2"/><joint joint="k" coef="1"/></fixed></tendon>
      <equality><joint joint1="k" joint2="j" polycoef="0 3 0 0 0"/></equality></mujoco>"""
    robot = load(text)  # the moment arm on the leader is 3 (2 + 3 1)
    np.testing.assert_allclose(robot.actuators.armature, [[0.3 * 15**2, 0]])


def test_floating_base(load):
    """A free joint in the file makes a free base, unless the caller fixes it."""
    fixed, floating = load(WALKER, fixed_base=True), load(WALKER, self_collision="none")
    assert fixed.dof == floating.dof == 2
    assert (fixed.fixed_base, floating.fixed_base) == (True, False)
    assert fixed.mjcf.lost == "bodies apart from the robot (2)"
    for engine in ("sapien", "mujoco"):
        with Runner(floating, num_envs=1, workers=0, engine=engine, ground=False) as runner:
            runner.reset()
            assert runner.step(floating.start).ok.all()


SITE = f'{BOX}<site name="s"/>'
DRIVEN = '<actuator><{} joint="j" {}/></actuator>'
REPAIRED = {  # a file, code of the finding in every engine, and what it says
    "gravity": (
        two_links(
            rest='<option gravity="0 0 0"><flag gravity="disable" actuation="disable"/></option>'
        ).replace('name="b"', 'name="b" gravcomp="1"'),
        "option",
        ": <flag actuation>, <flag gravity>, gravity, gravcomp of 'b';",
    ),
    "passive joint": (
        two_links('<joint name="j"/><joint name="k" axis="0 1 0"/>', DRIVEN.format("motor", "")),
        "actuator",
        "'k': no actuator",
    ),
    "one-sided force": (
        two_links(rest=DRIVEN.format("motor", 'forcerange="-2 5"')),
        "limits",
        r"'j' \(-2 to 5\): effort limits differ",
    ),
    "thruster": (
        two_links(rest='<actuator><motor site="s"/></actuator>').replace(BOX, SITE, 1),
        "actuator",
        "robot: actuator",
    ),
    "range of a servo": (
        two_links(rest=DRIVEN.format("position", 'ctrlrange="-.5 .7" gear="2"')),
        "limits",
        r"'j' \(-0.25 to 0.35\): its servo.*guard=True",
    ),
}
UNUSED = two_links(
    rest="""<option density="1.2"><flag sleep="enable" contact="disable"/></option>
    <tendon><fixed name="t" {tendon}><joint joint="j" coef="1"/></fixed></tendon>
    <equality><weld body1="b"/><joint joint1="j"/></equality>""",
    joint='<joint name="j" stiffness="{stiffness}" damping="1 5"/>',
)
UNUSED = UNUSED.replace(BOX, f"{SITE}<camera/>", 1).replace(
    "<worldbody>", '<worldbody><geom type="plane" size="1 1 1" pos="0 0 1"/>'
)


def said(robot, code, **options):
    return "\n".join(str(each) for each in robot.check(**options) if each.code == code)


@pytest.mark.parametrize("name", REPAIRED)
def test_what_is_simulated_otherwise_is_a_repair(load, name):
    text, code, message = REPAIRED[name]
    assert re.search(message, said(load(text), code))
    with pytest.raises(RobotError, match="needs"):
        load(text, strict=True)


@pytest.mark.parametrize("tendon", ['armature="2"', 'stiffness="0 2"', 'damping="0 2"'])
@pytest.mark.parametrize("stiffness", ["3", "0 5"])
def test_what_mujoco_alone_simulates_is_named_once(load, tendon, stiffness):
    robot = load(UNUSED.format(tendon=tendon, stiffness=stiffness), strict=True)
    assert robot.repairs == ()
    assert said(robot, "engine", engine="mujoco") == said(robot, "engine") == ""
    for name in (
        "equality constraints (2), tendons (1), springs (1), dampers that are not linear (1)",
        "planes, height fields and shapes of the world (1)",
        "properties of a medium (1), disabling <flag>s (1)",
    ):
        assert name in said(robot, "engine", engine="sapien")


def test_a_floating_robot_is_not_fixed_to_the_world(load):
    """Whose shapes are not its links'."""
    floor = '<geom type="plane" size="1 1 .1"/>'
    world = f'{floor}<geom name="wall" size=".1"/><geom type="box" size=".1 .1 .1"/>'
    rest = '<equality><weld name="hold" body1="leg1"/></equality>'
    robot = load(WALKER.replace("<worldbody>", f"{rest}<worldbody>{world}"))
    names = "robot (2), equality constraints (1), planes, height fields and shapes of the world (2)"
    assert names in said(robot, "engine", engine="sapien")
    level = load(two_links().replace("<worldbody>", f"<worldbody>{floor}"))
    assert level.check(engine="sapien") == level.check()


BAD = {
    "ball joint": (
        two_links().replace(
            "</body></body>",
            f'<body><joint name="wrist" type="ball"/>{BOX}</body></body></body>',
        ),
        "ball joint 'wrist'.*replace it by three hinges",
    ),
    "no joint": (two_links(""), "without moving joints"),
    "not compiled": (two_links('<joint name="j" pos="x"/>'), "MuJoCo cannot compile the file.*pos"),
    "no mass": (two_links(geom=""), "MuJoCo cannot compile the file.*mass"),
    "two robots": (
        two_links().replace(
            "</worldbody>",
            f'<body name="c"><freejoint/>{BOX}<body'
            f' name="d"><joint/>{BOX}</body></body></worldbody>',
        ),
        "several robots, 'a', 'c'",
    ),
    "a part": ("<mujocoinclude/>", "root element is <mujocoinclude>.*part of an MJCF"),
    "a DTD": (f'<!DOCTYPE mujoco [<!ENTITY a "b">]>{two_links()}', "DTD"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_simulated_is_refused(load, name):
    text, message = BAD[name]
    with pytest.raises(RobotError, match=message):
        load(text)


INERTIAL = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'


def test_files_that_are_only_drawn_may_be_missing(load, tmp_path):
    asset = '<texture name="t" type="2d" file="gone.png"/><material name="t" texture="t"/>'
    asset = f'<compiler meshdir="parts"/><asset>{asset}<mesh name="m" file="gone.stl"/></asset>'
    shown = '<geom type="mesh" mesh="m" material="t" contype="0" conaffinity="0"/>'
    box = BOX.replace("<geom", '<geom material="t"')
    assert load(two_links(rest=asset, geom=INERTIAL + box + shown)).repairs == ()
    solid = two_links(rest=asset, geom=INERTIAL + '<geom type="mesh" mesh="m"/>')
    (tmp_path / "parts").mkdir()
    for content in (None, b"solid wedge"):
        if content is not None:
            (tmp_path / "parts" / "gone.stl").write_bytes(content)
        with pytest.raises(RobotError, match=r"MuJoCo cannot compile the file: .*(gone|'m')"):
            load(solid)


@pytest.mark.parametrize("drawn", ["", 'contype="0" conaffinity="0"'])
@pytest.mark.parametrize("inferred", [False, True])
def test_a_missing_mesh_without_which_the_mass_is_unknown_is_refused(load, drawn, inferred):
    asset = f'<compiler inertiafromgeom="{"true" if inferred else "auto"}"/>'
    asset += '<asset><mesh name="m" file="gone.stl"/></asset>'
    shape = f'<geom type="mesh" mesh="m" {drawn}/>'
    for geom in (shape, BOX + shape, BOX + shape.replace("/>", ' mass="2"/>')):
        text = two_links(geom=INERTIAL * inferred + geom, rest=asset)
        with pytest.raises(RobotError, match=r"gone\.stl.*restore the file"):
            load(text)


@pytest.mark.parametrize("name", ["robot.xml", "robot.urdf"])
def test_a_git_lfs_pointer_in_place_of_the_robot_is_named(tmp_path, name):
    (tmp_path / name).write_bytes(
        b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n"
    )
    with pytest.raises(
        RobotError, match=r"robot\.\w+: a git-lfs pointer instead of the file; run git lfs pull"
    ):
        Robot.load(tmp_path / name)


def test_a_default_namespace_changes_nothing(load, tmp_path):
    (tmp_path / "part.xml").write_text(
        f'<mujocoinclude xmlns="urn:m"><body name="c">{BOX}</body></mujocoinclude>'
    )
    text = ARM.replace("</worldbody>", '<include file="part.xml"/></worldbody>')
    plain, named = (
        load(text),
        load(text.replace("<mujoco ", '<mujoco xmlns="http://mujoco.org/mjcf" ')),
    )
    assert (named.tables, named.repairs) == (plain.tables, plain.repairs)
    drawn = [[each.link for each in surfaces(robot)[0]] for robot in (named, plain)]
    assert drawn[0] == drawn[1]


def test_a_keyframe_is_part_of_a_files_identity(load):
    """The last bits are not."""
    texts = [
        f'<keyframe><key name="home" qpos="{at!r}"/></keyframe>' for at in (0.1, 0.1 + 1e-15, 0.2)
    ]
    first, same, other = (load(two_links(rest=text)) for text in texts)
    assert same.mjcf.content == first.mjcf.content != other.mjcf.content


def test_a_geom_that_is_referred_to_stays(load):
    """Without the geoms that are only drawn the file would not compile."""
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    geom = f'{inertial}{BOX}<geom name="shown" size=".1" contype="0" conaffinity="0"/>'
    sensor = '<sensor><framepos objtype="geom" objname="shown"/></sensor>'
    assert load(two_links(rest=sensor).replace(BOX, geom, 1)).dof == 1


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_file_is_a_robot_or_an_error(load, seed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # for MuJoCo's log
    rng = random.Random(seed)
    for _ in range(25):
        text = rng.choice([*TEXTS.values(), *(text for text, *_ in REPAIRED.values()), UNUSED])
        begin = rng.randrange(len(text))
        part = rng.choice(
            ["", "0", "-1", "nan", "1e300", "<joint/>", "<freejoint/>", "</body>", 'mass="0"', "<"]
        )
        with suppress(RobotError):
            load(text[:begin] + part + text[begin + rng.randrange(8) :])


def test_a_name_in_another_encoding_is_an_error_with_the_file(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_bytes(ARM.replace('"base"', '"körper"').encode("latin-1"))
    with pytest.raises(RobotError, match=r"arm\.xml: MuJoCo cannot .*'utf-8' codec"):
        Robot.load(path)
