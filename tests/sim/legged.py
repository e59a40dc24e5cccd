"""Robots on four legs: one whose legs slide, and one whose legs bend."""

from batchpid.sim import Robot

GRAVITY = 9.81
BALL = '<collision><origin xyz="0 0 -0.3"/><geometry><sphere radius="0.03"/></geometry></collision>'
LEG = """
  <link name="leg{0}"><inertial><origin xyz="0 0 -0.15"/><mass value="0.2"/>
    <inertia ixx="2e-3" iyy="2e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slide{0}" type="prismatic"><parent link="trunk"/><child link="leg{0}"/><origin xyz="{1} {2} -0.05"/>
    <axis xyz="0 0 1"/><limit lower="-0.1" upper="0.1" effort="200" velocity="5"/></joint>
  <link name="foot{0}"><inertial><origin xyz="0 0 -0.3"/><mass value="0.1"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>{3}</link>
  <joint name="ankle{0}" type="fixed"><parent link="leg{0}"/><child link="foot{0}"/><origin rpy="0 0 0.5"/></joint>"""
PLACES = ((0.2, 0.15), (0.2, -0.15), (-0.2, 0.15), (-0.2, -0.15))
STOOL = f"""<robot name="stool">
  <link name="trunk"><inertial><origin xyz="0.02 0 0.01"/><mass value="10"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.25" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.5 0.3 0.1"/></geometry></collision></link>
  {"".join(LEG.format(number, *place, BALL) for number, place in enumerate(PLACES))}
</robot>"""
WEIGHT = (10.0 + 4 * 0.3) * GRAVITY
FEET = [f"foot{number}" for number in range(4)]
GAINS = {"gain_units": "effort", "kp": 2e4, "ki": 0.0, "kd": 400.0}


LIMB = """
  <link name="{1}{0}"><inertial><origin xyz="0 0 -0.1"/><mass value="{2}"/>
    <inertia ixx="2e-3" iyy="2e-3" izz="2e-4" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 -0.2"/><geometry><sphere radius="0.02"/></geometry></collision></link>
  <joint name="{1}_joint{0}" type="revolute"><parent link="{3}"/><child link="{1}{0}"/><origin xyz="{4}" rpy="0 {5} 0"/>
    <axis xyz="0 1 0"/><limit lower="-1.5" upper="1.5" effort="60" velocity="20"/></joint>"""


def limbs(number, x, y):
    thigh = LIMB.format(number, "thigh", 1.0, "trunk", f"{x} {y} 0", 0.6)
    return thigh + LIMB.format(number, "calf", 0.2, f"thigh{number}", "0 0 -0.2", -1.2)


TRUNK = STOOL.partition('<link name="leg0">')[0]
DOG = f"{TRUNK}{''.join(limbs(number, *place) for number, place in enumerate(PLACES))}</robot>"


def load(folder, text=STOOL, **options):
    path = folder / "legged.urdf"
    path.write_text(text)
    return Robot.load(path, **{"fixed_base": False} | options)
