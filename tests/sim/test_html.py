"""Robots, findings, rollouts and figures of merit are tables in a notebook, and figures are pictures."""

import io
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from tiny_urdf import LIMIT, one_joint, write

from batchpid.metrics import step_metrics
from batchpid.sim import CommandSpec, Robot, Runner


@pytest.fixture(scope="module")
def rollout(panda):
    with Runner(panda, 3, workers=0) as runner:
        return runner.rollout(np.tile(panda.settings.target, (3, 1)))


def cells(html: str) -> list[list[str]]:
    """Return the text of each row of a table, the header first."""
    return [["".join(cell.itertext()) for cell in row] for row in ElementTree.fromstring(html).iter("tr")]


def test_a_robot_is_a_table_of_its_joints(panda):
    header, *rows = cells(panda._repr_html_())
    assert header[:4] == ["", "joint", "type", "limits"]
    assert [row[1] for row in rows] == list(panda.joint_names)
    assert rows[3][3] == "-3.0718 to -0.0698 rad"


def test_findings_are_rows_with_their_remedies(tmp_path):
    friction = one_joint(LIMIT + '<dynamics friction="12"/>')
    findings = Robot.load(write(tmp_path, friction)).check()
    rows = cells(findings._repr_html_())[1:]
    assert [(row[0], row[1], row[3]) for row in rows] == [(each.severity, each.where, each.remedy) for each in findings]
    assert repr(findings).splitlines() == list(map(str, findings))
    sound = Robot.load(write(tmp_path, one_joint())).check()
    assert repr(sound) == "[]"
    assert "No findings" in sound._repr_html_()


def test_a_rollout_has_a_row_for_each_joint(rollout, panda):
    header, *rows = cells(rollout._repr_html_())
    assert header[0] == "joint"
    assert [row[0] for row in rows] == list(panda.joint_names)
    assert rows[0][header.index("last setpoint")] == "1 rad"
    assert cells(rollout.for_ticks(slice(0, 0))._repr_html_()) == [[]]


def test_setpoints_that_are_not_joints_stand_above_the_table(rollout):
    info = replace(rollout.info, own_command=CommandSpec(("<x>", "y"), ("m", "m")))
    html = replace(rollout, setpoint=np.full((3, 3, 2), 0.25), info=info)._repr_html_()
    assert "last setpoint: &lt;x&gt; 0.25 m, y 0.25 m" in html
    assert "last setpoint" not in cells(html)[0]


def test_figures_of_merit_have_a_row_each(rollout):
    metrics = step_metrics(rollout.tick, rollout.setpoint[-1], rollout.qpos)
    assert [row[0] for row in cells(metrics._repr_html_())[1:]] == [name.replace("_", " ") for name in metrics._fields]
    assert len(cells(metrics.worst()._repr_html_())[0]) == 1 + 9


def test_the_plot_of_a_rollout_is_a_picture(rollout):
    figure = rollout.plot(joints=[1], title="one joint")
    assert Image.open(io.BytesIO(figure._repr_png_())).format == "PNG"
    assert figure.axes[0].get_title(loc="left") == "panda_joint2"
