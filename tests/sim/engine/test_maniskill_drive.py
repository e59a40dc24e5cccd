"""ManiSkill's controller on PhysX: its drives, set from an exported configuration, against their equation."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from tiny_urdf import joint, link, robot, write

import batchpid as bp
from batchpid.export import to_maniskill
from batchpid.sim.engine.sapien.building import physx
from batchpid.sim.engine.sapien.user_content import HeadlessScene

JOINTS, DT = ["shoulder", "elbow", "wrist"], 1 / 100
"""Three joints on one base, with the inertia 0.1 kg m^2 each and their centers of mass on their axes."""


def controlled(text, path, iterations, tgs):
    """Return a scene with a robot, and its joints as mani_skill/agents/controllers/pd_joint_pos.py sets them."""
    module = ModuleType("mani_skill.agents.controllers")
    module.PDJointPosControllerConfig = lambda **given: SimpleNamespace(drive_mode="force", **given)
    sys.modules["mani_skill.agents.controllers"] = module
    try:
        exec(text, space := {})
    finally:
        del sys.modules["mani_skill.agents.controllers"]
    before = physx.get_scene_config()
    try:
        physx.set_scene_config(enable_tgs=tgs)
        config, scene = space["CONTROLLER"], HeadlessScene()
    finally:
        physx.set_scene_config(before)
    scene.set_timestep(DT)
    loader = scene.create_urdf_loader()
    loader.fix_root_link = True
    body = loader.load(str(path))
    body.set_solver_position_iterations(iterations)
    for each in body.links:
        each.set_angular_damping(0.0)
    active = {each.name: each for each in body.get_active_joints()}
    joints = [active[name] for name in config.joint_names]
    for each, *own in zip(joints, config.stiffness, config.damping, config.force_limit, strict=True):
        each.set_drive_properties(*own, config.drive_mode)
        each.set_friction(config.friction)
    return scene, body, joints


@pytest.mark.parametrize("tgs", [True, False])
def test_the_drives_move_as_their_equation(tmp_path, tgs):
    """m (v+ - v) / h = k (r - q+) - c v+, q+ = q + h v+, with the impulse of a step within L dt.

    h is the time step under PGS, and dt / 15 under TGS with ManiSkill's default of 15 position iterations.
    """
    params = bp.make_params(3, [40.0, 20.0, 5.0], None, [4.0, 1.0, 0.5], effort_limit=[3.0, np.inf, 0.5])
    params = params.replace(measurement_rate="measured")
    limit = '<limit lower="-9" upper="9" effort="10" velocity="99"/>'
    parts = [link("base"), *(link(name) for name in "xyz")]
    parts += [joint(name, "base", child, inner=limit) for name, child in zip(JOINTS, "xyz", strict=True)]
    text, _ = to_maniskill(params, JOINTS, DT)
    scene, body, joints = controlled(text, write(tmp_path, robot(*parts)), 15, tgs)
    k, c, most = (getattr(params, name)[0] for name in ("kp", "kd", "effort_max"))
    order = [body.get_active_joints().index(each) for each in joints]
    q, v, m, limited = np.zeros(3), np.zeros(3), 0.1, 0
    substeps = 15 if tgs else 1
    h = DT / substeps
    for step in range(150):
        r = 0.5 * np.sin(0.1 * step + np.arange(3))
        for each, target in zip(joints, r, strict=True):
            each.set_drive_target(target)
        scene.step()
        impulse = np.zeros(3)
        for _ in range(substeps):
            free = (v + h * k * (r - q) / m) / (1 + h * c / m + h**2 * k / m)
            total = np.clip(impulse + m * (free - v), -most * DT, most * DT)
            v, impulse = v + (total - impulse) / m, total
            q = q + h * v
        limited += np.isin(impulse, (-most * DT, most * DT)).sum()
        np.testing.assert_allclose(body.get_qpos()[order], q, atol=2e-5)
    assert 10 < limited < 290
    assert np.abs(q).max() > 0.1
