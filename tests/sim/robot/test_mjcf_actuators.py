"""Every actuator of an MJCF file acts as in MuJoCo, or a finding names it."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco")
pytest.importorskip("mujoco.batch")

from batchpid.sim import Robot, Runner, StabilityWarning  # noqa: E402

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
RANGES = 'ctrlrange="-.6 .5"', 'forcerange="-3 3"', 'ctrlrange="-.6 .6" forcerange="-3 3"'
TARGETS = (
    'joint="j"',
    'joint="j" gear="-3"',
    'jointinparent="j"',
    'joint="j" gear="0"',
    'tendon="one"',
    'tendon="two"',
    'tendon="no"',
    'tendon="string" lengthrange="0 1"',
    'site="s"',
    'site="s" refsite="world"',
    'body="b"',
    'cranksite="s" slidersite="t" cranklength="1"',
)


PLUGIN = '<plugin plugin="mujoco.pid" {} actdim="0"><config key="kp" value="5"/></plugin>'


SHORTCUTS = (
    "<motor {}/>",
    '<position kp="5" {}/>',
    '<position kp="5" kv="2" {}/>',
    '<position kp="5" timeconst=".1" {}/>',
    '<velocity kv="2" {}/>',
    '<intvelocity kp="5" actrange="-1 1" {}/>',
    '<damper kv="2" {}/>',
    '<cylinder timeconst=".1" area="2" bias="0 -5 0" {}/>',
    '<muscle lengthrange="0 1" {}/>',
    "<adhesion {}/>",
    '<orientation kp="1" {}/>',
    '<pid kp="5" kv="2" {}/>',
    '<pid kp="5" kv="2" ki="1" imax=".2" slewmax="1e12" {}/>',
    '<pid kp="5" input="vel ff" {}/>',
    '<dcmotor nominal="24 6 3" {}/>',
    '<dcmotor nominal="24 6 3" input="pos" controller="5 0 1" {}/>',
    PLUGIN,
)


def generals():
    """Yield <general> actuators of every kind that this version of MuJoCo has, with numbers that
    matter.
    """
    kinds = [
        [
            name.removeprefix(f"mj{kind.upper()}_").lower()
            for name in getattr(mujoco, f"mjt{kind.capitalize()}").__members__
        ]
        for kind in ("gain", "bias", "dyn")
    ]
    for gain, bias, dyn in itertools.product(*kinds):
        kind = f'gaintype="{gain}" biastype="{bias}" dyntype="{dyn}"'
        yield (
            f'<general {kind} gainprm="4" biasprm="0 -5 -2" dynprm=".1" lengthrange="0 1"'
            ' actrange="-1 1" {}/>'
        )
    for gain, bias in itertools.product(
        ("0", "-3"), ("0 0 0", "1 0 0", "0 -5 0", "0 0 -2", "0 5 -2", "0 -5 2")
    ):
        yield f'<general biastype="affine" gainprm="{gain}" biasprm="{bias}" {{}}/>'


def compiled(text):
    """Return the model of an MJCF text, None if MuJoCo refuses it."""
    try:
        return mujoco.MjModel.from_xml_string(text)
    except (ValueError, mujoco.FatalError):
        return None


def efforts(model, control, state):
    """Return the effort on the first joint for controls (n, nu) at states (n, 2), position and
    velocity.
    """
    data, found = mujoco.MjData(model), []
    for u, (q, v) in zip(control, state, strict=True):
        data.ctrl[:], data.qpos[0], data.qvel[0] = u, q, v
        mujoco.mj_forward(model, data)
        found.append(data.qfrc_actuator[0])
    return np.array(found)


def check_law(robot, model, text):
    """Assert that the effort is linear in the setpoint and has the gains and limits of the robot,
    in MuJoCo as here.
    """
    kp = kd = 0.0
    if robot.defaults.kp is not None:
        gains = robot.mjcf_gains()
        kp, kd = gains.kp[0, 0], gains.kd[0, 0]
    limit = robot.effort_limit[0]
    rng = np.random.default_rng(0)
    state = np.concatenate([np.zeros((2, 2)), rng.uniform(-0.3, 0.3, (20, 2))])
    control = np.zeros((len(state), model.nu))
    control[0], control[1:] = 0.1, rng.uniform(-0.2, 0.2, (len(state) - 1, 1))
    control[1] = 0.0
    found = efforts(model, control, state)
    forward = (found[0] - found[1]) / 0.1  # small enough to be within the limits
    expected = np.clip(control[:, 0] * forward - state @ [kp, kd], -limit, limit)
    np.testing.assert_allclose(found, expected, atol=1e-9, err_msg=text)
    most = np.abs(efforts(model, np.tile([[-1e3], [1e3]], model.nu), np.zeros((2, 2)))).max()
    if kp == kd == 0:  # a servo may be limited by its setpoint
        assert limit == most or (limit == np.inf and most >= 500 * abs(forward)), text


CASES = [*SHORTCUTS, *generals()]


@pytest.mark.parametrize("targets", [TARGETS[:1], TARGETS[1:]], ids=["joint", "others"])
def test_every_actuator_acts_as_in_mujoco_or_is_named(tmp_path, targets):
    path, rng, read, named = tmp_path / "robot.xml", np.random.default_rng(0), 0, 0
    own = SHORTCUTS if len(targets) == 1 else rng.choice(SHORTCUTS, 8, replace=False)
    cases = [*own, *rng.choice(CASES, 90 if len(targets) == 1 else 4)]
    for case, target in itertools.product(cases, targets):
        extras = " ".join(
            (target, *rng.choice(["", *RANGES], 1), *rng.choice(["", 'name="motor"'], 1))
        )
        text = FILE.format(extension=PID, beside='<geom size=".1"/>', actuators=case.format(extras))
        if (model := compiled(text)) is None:
            continue
        path.write_text(text)
        robot = Robot.load(path, self_collision="none")
        label = "'motor'" if 'name="motor"' in extras else "'number 0'"
        if any(each.code == "actuator" and label in each.text for each in robot.repairs):
            named += 1
        elif not any(
            each.code in ("actuator", "limits") and each.joint == "j" for each in robot.repairs
        ):
            check_law(robot, model, text)
            read += 1
    assert min(read, named) > 0


@pytest.fixture
def load(tmp_path):
    """Function that loads the robot of FILE."""

    def load(actuators, extension=PID, beside='<geom size=".1"/>'):
        path = tmp_path / "robot.xml"
        path.write_text(FILE.format(extension=extension, actuators=actuators, beside=beside))
        return Robot.load(path, self_collision="none")

    return load


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
        each
        for each in robot.check(params=robot.mjcf_gains())
        if each.joint is None and each.code == "unstable"
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
    assert any(
        "'number 0' has effects" in str(each) and "left out" in str(each) for each in robot.repairs
    )
