"""Every actuator of an MJCF file acts as in MuJoCo, or a finding names it."""

import mujoco
import numpy as np
import pytest

from batchpid.errors import RobotError
from batchpid.sim import Robot, Runner, StabilityWarning

PID = '<extension><plugin plugin="mujoco.pid"/></extension>'
FILE = """<mujoco>{extension}<compiler angle="radian"/><option timestep="1e-9"/>
  <worldbody><site name="world"/>
    <body name="a"><geom size=".1" mass="1"/><joint name="j" axis="0 1 0" range="-2 2"/><site name="s" pos=".1 0 0"/>
      <body name="b" pos="0 0 .5"><geom size=".1" mass="1"/><joint name="k" axis="0 1 0"/><site name="t"/></body></body>
    <body name="beside" pos="3 0 0">{beside}</body>
  </worldbody>
  <tendon><fixed name="one"><joint joint="j" coef="2"/></fixed><fixed name="no"><joint joint="j" coef="0"/></fixed>
    <fixed name="two"><joint joint="j" coef="1"/><joint joint="k" coef="-1"/></fixed>
    <spatial name="string"><site site="world"/><site site="t"/></spatial></tendon>
  <actuator>{actuators}</actuator></mujoco>"""


@pytest.fixture
def load(tmp_path):
    """Function that loads the robot of FILE."""

    def load(actuators, extension=PID, beside='<geom size=".1"/>'):
        path = tmp_path / "robot.xml"
        path.write_text(FILE.format(extension=extension, actuators=actuators, beside=beside))
        return Robot.load(path, self_collision="none")

    return load


def efforts(model, control, state):
    """Return the effort on the first joint for controls (n,) at states (n, 2), position and
    velocity.
    """
    data, rows = mujoco.MjData(model), []
    for u, (q, v) in zip(control, state, strict=True):
        data.ctrl[0], data.qpos[0], data.qvel[0] = u, q, v
        mujoco.mj_forward(model, data)
        rows.append(data.qfrc_actuator[0])
    return np.array(rows)


READ = {  # of an actuator with a moment arm of 1: input's gain, kp, kd, and limit of the effort
    "<motor {}/>": (1, 0, 0, np.inf),
    '<motor armature=".3" {}/>': (1, 0, 0, np.inf),
    '<motor forcerange="-3 3" {}/>': (1, 0, 0, 3),
    '<motor ctrlrange="-4 4" {}/>': (1, 0, 0, 4),
    '<motor ctrlrange="-4 4" forcerange="-3 3" {}/>': (1, 0, 0, 3),
    '<general gainprm="4" ctrlrange="-.5 .5" {}/>': (4, 0, 0, 2),
    '<position kp="5" {}/>': (5, 5, 0, np.inf),
    '<position kp="5" kv="2" forcerange="-3 3" {}/>': (5, 5, 2, 3),
    '<position kp="5" ctrlrange="-9 9" {}/>': (5, 5, 0, np.inf),
    '<general gainprm="4" biastype="affine" biasprm="0 -5 -2" {}/>': (4, 5, 2, np.inf),
}
ARMS = {
    'joint="j"': 1,
    'jointinparent="j"': 1,
    'joint="j" gear="-3"': -3,
    'tendon="one"': 2,
    'tendon="one" gear="2"': 4,
}


@pytest.mark.parametrize("case", READ)
def test_motors_and_servos_act_as_in_mujoco(load, case):
    """The effort is linear in the setpoint, with the gains, the limit and the armature of the
    robot.
    """
    state = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2))
    control = np.linspace(-0.2, 0.2, 20)
    gain, kp, kd, limit = READ[case]
    for target, arm in ARMS.items():
        robot = load(case.format(target))
        assert not [each for each in robot.repairs if each.joint == "j"]
        gains = robot.mjcf_gains() if kp else None
        assert gains is None or (gains.kp[0, 0], gains.kd[0, 0]) == (arm**2 * kp, arm**2 * kd)
        assert robot.effort_limit[0] == abs(arm) * limit
        model = mujoco.MjModel.from_xml_string(robot.path.read_text())
        expected = arm * gain * control - state @ [arm**2 * kp, arm**2 * kd]
        bounds = -robot.effort_limit[0], robot.effort_limit[0]
        np.testing.assert_allclose(
            efforts(model, control, state), np.clip(expected, *bounds), atol=1e-9
        )
        if kp == 0:  # that of a servo may be its setpoint's
            most = np.abs(efforts(model, [-1e3, 1e3], np.zeros((2, 2)))).max()
            assert most == abs(arm) * min(1e3 * gain, limit)
        data, full = mujoco.MjData(model), np.zeros((2, 2))
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        added = np.diag(full - robot.mass_matrix(np.zeros(2))[0])
        if "armature" in case:
            np.testing.assert_allclose(added, robot.actuators.armature[0], atol=1e-9)
        else:
            assert robot.actuators is None
            np.testing.assert_allclose(added, 0, atol=1e-9)


ELSEWHERE = (
    'joint="j" gear="0"',
    'tendon="two"',
    'tendon="no"',
    'tendon="string" lengthrange="0 1"',
    'site="s"',
    'site="s" refsite="world"',
    'body="b"',
    'cranksite="s" slidersite="t" cranklength="1"',
)
OTHERS = (
    '<position kp="5" timeconst=".1" {}/>',
    '<velocity kv="2" {}/>',
    '<intvelocity kp="5" actrange="-1 1" {}/>',
    '<damper kv="2" ctrlrange="0 1" {}/>',
    '<cylinder timeconst=".1" area="2" bias="0 -5 0" {}/>',
    '<muscle lengthrange="0 1" {}/>',
    '<pid kp="5" {}/>',
    '<motor delay="0.01" nsample="9" {}/>',
    '<dcmotor nominal="24 6 3" {}/>',
    '<plugin plugin="mujoco.pid" actdim="0" {}><config key="kp" value="5"/></plugin>',
    '<general biastype="affine" gainprm="3" biasprm="1 0 0" {}/>',
    '<general biastype="affine" gainprm="3" biasprm="0 5 -2" {}/>',
    '<general biastype="affine" gainprm="0" biasprm="0 -5 0" {}/>',
)


@pytest.mark.parametrize("label", ["motor", "number 0"])
def test_every_other_actuator_is_named(load, label):
    name = 'name="motor"' if label == "motor" else ""
    extras = 'lengthrange="0 1" actrange="-1 1" {}/>'
    kinds = [
        f'<general {kind}type="{each.removeprefix(f"mj{kind.upper()}_").lower()}" {extras}'
        for kind in ("gain", "bias", "dyn")
        for each in getattr(mujoco, f"mjt{kind.capitalize()}").__members__
        # these are read, and no file can have one
        if not each.endswith(("_FIXED", "_NONE", "_AFFINE"))
    ]
    texts = [case.format(f'joint="j" {name}') for case in (*OTHERS, *kinds)]
    texts += [f"<motor {target} {name}/>" for target in ELSEWHERE]
    named = 0
    for text in texts:
        try:
            robot = load(text)
        except RobotError:  # MuJoCo compiles not every combination
            continue
        told = [each.text for each in robot.repairs if each.code == "actuator"]
        assert any(f"'{label}' has effects" in each for each in told), text
        named += 1
    assert named >= len(OTHERS) + len(ELSEWHERE)


WITHOUT_CONTACT = '<option><flag contact="disable"/></option><worldbody>'


SERVO = '<position joint="{}" kp="{}" kv="{}" forcerange="-90 90"/>'


@pytest.mark.parametrize(("kp", "kv"), [(2000, 200), (500, 900), (9000, 400)])
def test_stiff_servos_diverge_as_pid_and_not_as_drives(load, kp, kv):
    """MuJoCo integrates the gain kv implicitly."""
    robot = load(SERVO.format("j", kp, kv) + SERVO.format("k", kp, kv), extension="")
    text = robot.path.read_text().replace("1e-9", "5e-4").replace("<worldbody>", WITHOUT_CONTACT)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    data, goal = mujoco.MjData(model), np.array([0.02, 0.03])
    data.ctrl[:] = goal
    mujoco.mj_step(model, data, 400)
    options = {
        "engine": "mujoco",
        "compensate": "none",
        "ground": False,
        "workers": 0,
        "substeps": 400,
    }
    (unstable,) = [
        each for each in robot.check(params=robot.mjcf_gains()) if each.code == "unstable"
    ]
    with pytest.warns(
        StabilityWarning,
        match="control='drive'",
    ):
        Runner(robot, 1, params=robot.mjcf_gains(), **options).close()
    assert "control='drive'" in unstable.remedy
    with Runner(robot, 1, params=robot.mjcf_gains(), control="drive", **options) as runner:
        runner.reset([0, 0])
        np.testing.assert_allclose(runner.step(goal).qpos[0], data.qpos, atol=1e-3)


def test_an_actuator_of_another_object_is_named(load):
    held = '<body name="lid"><joint name="hinge"/><geom size=".1"/></body>'
    robot = load('<motor joint="hinge"/><motor joint="j"/>', beside=held)
    assert robot.dof == 3
    robot.path.write_text(robot.path.read_text().replace('"beside"', '"beside" mocap="true"'))
    robot = Robot.load(robot.path)
    assert robot.joint_names == ("j", "k")
    assert any("'number 0' has effects" in str(each) for each in robot.repairs)
