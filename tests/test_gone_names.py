"""Names of removed features stand in no page, docstring, message or help."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GONE = (
    # one a line, as a regular expression; sorted by their letters
    r"accept_differences",
    r"actuator_presets",
    r"\bapply_set\b",
    r"batchpid\[(bench|data|logs|mjx|peers|record|render|robots|ruckig|sb3|train)\]",
    r"batchpid identify --resume",
    r"batchpid parity",
    r"batchpid render",
    r"batchpid\[sb3\]",
    r"batchpid\.sim\.gym\.(push|walk|tool_vector_env|stable_baselines3)",
    r"batchpid[./]startup",
    r"batchpid survey",
    r"batchpid tune --resume",
    r"\bcheck_guard\b|\bmotors\.check_actuators\b",
    r"\bcheck_renderer\b",
    r"\bcompiled_stages\b",
    r"\bdc_motor\(",
    r"\bdelayed_pd\b",
    r"bench/(accuracy|circles|film|motions|newcomer|trajectories|view)\.py",
    r"bench/cluster",
    r"\bestimate_memory\b|\bcheck_memory\b",
    r"\bexit_at_once\b",
    r"\bgizmo\b",
    r"\bis_ros2_control\b",
    r"\bjerk_limited\b|import ruckig",
    r"\bmesa-vulkan-drivers\b",
    r"\bPushEnv\b",
    r"\bPush-v0\b",
    r"\brecover=",
    r"\bremotized\b",
    r"\bRenderError\b",
    r"\brender_problem\b",
    r"\bshow_window\b",
    r"\bsurvey_table\b|\bsurvey_summary\b",
    r"\bToolCandidates\b|\bToolMoves\b",
    r"\bToolReach-v0\b",
    r"\bToolVectorEnv\b",
    r"build_digest|controller_digest|canonical_digest",
    r"\bWalkEnv\b",
    r"\bWalk-v0\b",
    r"checkpoint_steps",
    r"ClusterWarning",
    r"compare_engines",
    r"control_toolbox\(",
    r"decoupling=",
    r"DriveChatter",
    r"--duration\b",
    r"effort_ratios",
    r"engine_differences",
    r"engine_parity",
    r"--evaluations",
    r"find_robots",
    r"first_derivative",
    r"fork_server",
    r"fork server",
    r"--(friction|payload|resume|window)\b",
    r"from_ros2_control",
    r"gain_units=.inertia",
    r"held_out_error\(",
    r"h5[.]partial",
    r"identification/(plant|columns|held_out|problem)\b",
    r"integral-limit",
    r"integrate_first",
    r"is_feasible",
    r"jitted_law",
    r"law in XLA \(float",
    r"link_reach",
    r"log_lists|read_log_list",
    r"make accuracy",
    r"--measured\b",
    r"measured_motors",
    r"measured_rate\b",
    r"merge_fixed\b",
    r"motors\.presets",
    r"mujoco[.]pid",
    r"NoDecoupling|PartialDecoupling",
    r"(notes|own-simulator)\.md",
    r"object_digest",
    r"open_dataset",
    r"osc_files",
    r"osc_options",
    r"osc_presets",
    r"partial_file",
    r"payload_capacity",
    r"per_inertia",
    r"physics=.free\b",
    r"pip install '?\.\[[^]]*\b(data|logs|record|render|ruckig|train)\b",
    r"placement=",
    r"presets\.simple_pid",
    r"--project",
    r"read_region",
    r"register_dynamics",
    r"register_findings",
    r"register_plot",
    r"_repr_html_",
    r"robot\.run_info",
    r"robot_survey",
    r"robot[./]unsettled",
    r"rollout .*--resume",
    r"ros2_control_reader",
    r"runner_arguments",
    r"runner_commands",
    r"runner_keywords",
    r"Runner\([^)]*dtype=",
    r"--search-seconds",
    r"setpoint_space",
    r"sim/gym/(push|walk)",
    r"sim\.processes",
    r"sim_steps=",
    r"--sim-steps",
    r"sim[.]sweep",
    r"start-in-ground",
    r"--time-unit",
    r"to_c_project",
    r"to_dataset",
    r"to_isaac_lab",
    r"--to (isaac_lab|maniskill|newton)",
    r"to_maniskill",
    r"to_newton",
    r"tool_candidates",
    r"tool_search",
    r"ToolSetpoints",
    r"tool_setpoints",
    r"ToolTuning",
    r"try_writing",
    r"ts\.presets",
    r"tune_tool",
    r"usual_variation",
    r"--variation",
    r"--viewer",
    r"view[^\n]* --control",
    r"weight_origin",
    r"--within",
    r"xarray",
)
FILES = [
    path
    for pattern in (
        "README.md",
        "CONTRIBUTING.md",
        "SECURITY.md",
        "Makefile",
        "pyproject.toml",
        "docs/*.md",
    )
    for path in ROOT.glob(pattern)
] + [
    path
    for folder in ("batchpid", "sim", "bench", "examples")
    for path in (ROOT / folder).rglob("*.py")
]


@pytest.mark.parametrize("name", GONE or [None])
def test_no_file_names_what_is_gone(name: str | None) -> None:
    pattern = re.compile(name) if name else None
    naming = [
        str(path.relative_to(ROOT))
        for path in FILES
        if pattern and pattern.search(path.read_text())
    ]
    assert not naming, f"{name!r} is gone, but these files name it: {naming}"
