"""Names of removed features stand in no page, docstring, message or help."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GONE = (
    # one a line, as a regular expression; sorted
    "_repr_html_",
    "h5[.]partial",
    "integral-limit",
    "mujoco[.]pid",
    "open_dataset",
    "register_findings",
    "register_plot",
    "rollout .*--resume",
    "sim[.]sweep",
    "start-in-ground",
    "to_dataset",
    "xarray",
    r"--duration\b",
    r"--evaluations",
    r"--measured\b",
    r"--project",
    r"--search-seconds",
    r"--sim-steps",
    r"--time-unit",
    r"--to (isaac_lab|maniskill|newton)",
    r"--variation",
    r"--viewer",
    r"--within",
    r"ClusterWarning",
    r"DriveChatter",
    r"ToolSetpoints",
    r"ToolTuning",
    r"\bPush-v0\b",
    r"\bPushEnv\b",
    r"\bRenderError\b",
    r"\bToolReach-v0\b",
    r"\bToolVectorEnv\b",
    r"\bWalk-v0\b",
    r"\bWalkEnv\b",
    r"\bapply_set\b",
    r"\bcheck_renderer\b",
    r"\bgizmo\b",
    r"\bmesa-vulkan-drivers\b",
    r"\brender_problem\b",
    r"\bshow_window\b",
    r"accept_differences",
    r"actuator_presets",
    r"batchpid identify --resume",
    r"batchpid parity",
    r"batchpid render",
    r"batchpid survey",
    r"batchpid tune --resume",
    r"batchpid[./]startup",
    r"batchpid\.sim\.gym\.(push|walk|tool_vector_env|stable_baselines3)",
    r"batchpid\[sb3\]",
    r"bench/(accuracy|circles|film|motions|newcomer|trajectories|view)\.py",
    r"bench/cluster",
    r"checkpoint_steps",
    r"compare_engines",
    r"control_toolbox\(",
    r"decoupling=",
    r"engine_differences",
    r"engine_parity",
    r"find_robots",
    r"first_derivative",
    r"fork server",
    r"fork_server",
    r"from_ros2_control",
    r"gain_units=.inertia",
    r"held_out_error\(",
    r"integrate_first",
    r"is_feasible",
    r"jitted_law",
    r"law in XLA \(float",
    r"make accuracy",
    r"measured_motors",
    r"merge_fixed\b",
    r"motors\.presets",
    r"object_digest",
    r"osc_files",
    r"osc_options",
    r"osc_presets",
    r"payload_capacity",
    r"per_inertia",
    r"physics=['\"]free",
    r"placement=",
    r"presets\.simple_pid",
    r"read_region",
    r"register_dynamics",
    r"robot_survey",
    r"runner_commands",
    r"setpoint_space",
    r"sim_steps=",
    r"to_c_project",
    r"to_isaac_lab",
    r"to_maniskill",
    r"to_newton",
    r"tool_candidates",
    r"tool_search",
    r"tool_setpoints",
    r"try_writing",
    r"ts\.presets",
    r"tune_tool",
    r"usual_variation",
    r"view[^\n]* --control",
    r"weight_origin",
)
FILES = [
    path
    for pattern in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "Makefile", "pyproject.toml", "docs/*.md")
    for path in ROOT.glob(pattern)
] + [path for folder in ("batchpid", "sim", "bench", "examples") for path in (ROOT / folder).rglob("*.py")]


@pytest.mark.parametrize("name", GONE or [None])
def test_no_file_names_what_is_gone(name: str | None) -> None:
    pattern = re.compile(name) if name else None
    naming = [str(path.relative_to(ROOT)) for path in FILES if pattern and pattern.search(path.read_text())]
    assert not naming, f"{name!r} is gone, but these files name it: {naming}"
