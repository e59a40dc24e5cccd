"""Names of strangers' robots stand in every file and picture as they are, and nothing else is read
from them.
"""

import subprocess
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np
import pytest
import yaml
from c_programs import COMPILERS
from hypothesis import example, given, settings
from hypothesis import strategies as st
from matplotlib.cbook import is_math_text
from tiny_urdf import joint, link, robot, write

import batchpid as bp
from batchpid.errors import InvalidArgumentError, RobotError
from batchpid.export import to_c, to_ros2_control
from batchpid.sim import Robot, Runner, to_mjcf, to_urdf
from batchpid.sim.recording.setpoint_files import read_setpoints, setpoint_csv

SPECIAL = "\\/*?$,;\"'#:-{<>&|!%@`~^=[]() \u00a0\u202e\ufeff"
characters = st.sampled_from(SPECIAL) | st.characters(
    exclude_categories=("Cs", "Cc", "Zl", "Zp", "Cn")
)
names_of_joints = st.text(characters, min_size=1, max_size=12).map(str.strip).filter(bool)


def robot_with(folder, name):
    parts = [link("base"), link("upper"), link("lower")]
    parts += [joint("NAME", "base", "upper"), joint("plain", "upper", "lower")]
    return Robot.load(write(folder, robot(*parts).replace('"NAME"', quoteattr(name))))


def tokens(header, standard):
    command = [COMPILERS[0], "-E", "-P", f"-std={standard}", "-x", "c", "-"]
    return subprocess.run(command, input=header.encode(), capture_output=True, check=True).stdout


@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
@given(name=names_of_joints)
@example("a*\\/ int stranger; /\\*")
@example("a??/")
@settings(max_examples=20)
def test_c_reads_nothing_from_a_name(name):
    params = bp.make_params(1, 1.0)
    for standard in ("c99", "c11"):
        plain, strange = (
            tokens(to_c(params, 0.01, joint_names=[each]).text, standard)
            for each in ("plain", name)
        )
        assert strange == plain


@given(name=names_of_joints)
@example('a,"b;')
@example("$\\foo$")
@example("$a$")
@settings(max_examples=8)
def test_files_hold_the_name_and_pictures_show_it(tmp_path_factory, name):
    folder = tmp_path_factory.mktemp("names")
    loaded = robot_with(folder, name)
    assert loaded.joint_names == (name, "plain")
    params = bp.make_params(2, 1.0, measurement_rate="measured")
    model = mujoco.MjModel.from_xml_string(to_mjcf(loaded, params, 0.01).text)
    assert [model.joint(at).name for at in range(2)] == [name, "plain"]
    assert Robot.load(write(folder, to_urdf(loaded).text)).joint_names == loaded.joint_names
    manager = yaml.safe_load(to_ros2_control(params, loaded.joint_names, 0.01).text)
    written = manager["joint_trajectory_controller"]["ros__parameters"]
    assert (written["joints"], set(written["gains"])) == ([name, "plain"], {name, "plain"})
    bp.save_params(folder / "gains.yaml", params, loaded.joint_names)
    bp.load_params(folder / "gains.yaml", loaded.joint_names)
    motion = bp.trajectories.minimum_jerk(np.zeros(2), np.full(2, 0.01), 0.01, duration=0.1)
    (folder / "motion.csv").write_text(setpoint_csv(loaded, motion), encoding="utf-8")
    read = read_setpoints(loaded, folder / "motion.csv", 0.0005)
    np.testing.assert_allclose(read.position, motion.position[1:], atol=1e-6)
    with Runner(loaded, 1, engine="mujoco", workers=0) as runner:
        figure = runner.rollout(np.zeros((3, 2))).plot()
    title = figure.axes[0].get_title(loc="left")
    assert (is_math_text(title), title.replace("\\$", "$")) == (False, name)


@pytest.mark.parametrize("name", ["a\nb", "a\tb", "a\x85b", "a\u2028b"])
def test_names_of_several_lines_are_refused(name, tmp_path):
    escaped = name.replace("\n", "&#10;").replace("\t", "&#9;")
    path = write(tmp_path, robot(link("base"), link("upper"), joint(escaped, "base", "upper")))
    with pytest.raises(RobotError, match="control character or a line break"):
        Robot.load(path)
    with pytest.raises(InvalidArgumentError, match="control character or a line break"):
        to_c(bp.make_params(1, 1.0), 0.01, joint_names=[name])
