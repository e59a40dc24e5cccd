"""Every code block of the pages runs; every command, link and make target in their text exists.

Python blocks of a page share one namespace, in order, and run with few envs and ticks; where they
choose no workers, those of other pages than the README run in this process. ``<!-- needs: NAME
-->`` above a block names a package without which it is skipped. Commands of shell blocks run too,
in a folder with ``arm.urdf``, ``arm.xml``, ``gains.yaml`` and ``motors.yaml``; commands that would
take minutes or wait for a person are cut short or only parsed, and so are commands within the text.
C blocks compile next to the files that the commands of their page write.
"""

import importlib.util
import re
import shlex
import shutil
import subprocess
import warnings
from functools import partial
from pathlib import Path

import pytest
from pages import (
    BLOCK,
    PAGES,
    ROOT,
    SHORTER,
    SHORTER_CODE,
    TWO_JOINTS,
    blocks,
    missing,
    shell_lines,
)
from tiny_urdf import write

import batchpid as bp
import batchpid.sim
from batchpid.sim import Robot, Runner
from batchpid.sim.cli import main, parse
from batchpid.sim.cli.commands import COMMANDS

TEXTS = sorted({*PAGES, *ROOT.glob("*.md"), ROOT / "assets/README.md"})
MJCF = """<mujoco>
<worldbody><body><joint name="hinge" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/></body></worldbody>
<actuator><position joint="hinge" kp="100" kv="10"/></actuator></mujoco>"""
ON_TWO_JOINTS = ("docs/sim-to-real.md",)  # a fit of all joints of the panda is slow
RARE = {
    # pages whose blocks seldom change and take seconds: slow
    "python": ("docs/sim-to-real.md", "docs/controllers.md"),
    "sh": ("docs/performance.md", "docs/files.md", "docs/deploy.md", "docs/sim-to-real.md"),
}
ONLY_PARSED = ("tune", "identify")


def name(page):
    return str(page.relative_to(ROOT))


def pages_with(language):
    """Return the pages with blocks in ``language``, the rare ones marked as slow."""
    marks = {page: [pytest.mark.slow] if name(page) in RARE[language] else [] for page in PAGES}
    return [pytest.param(page, marks=marks[page]) for page in PAGES if blocks(page, language)]


def test_every_block_is_of_a_kind_that_is_run():
    for page in PAGES:
        for match in BLOCK.finditer(page.read_text()):
            assert match["language"] in (
                "python",
                "sh",
                "c",
                "text",
            ), f"{page.name}: {match[0][:60]}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_a_page_begins_with_a_program_and_fits_a_screen(page):
    text = page.read_text()
    assert [line for line in text.splitlines() if len(line) > 120] == []
    first = BLOCK.search(text)
    assert first is None or first["language"] in ("python", "sh"), first[0]


def test_what_a_program_prints_it_also_states():
    """A figure in a comment behind print() may become wrong, a statement cannot."""
    for page in PAGES:
        for match in blocks(page, "python"):
            claims = "assert" in match["code"] or "print(" not in match["code"]
            assert claims, f"{page.name}: {match['code'][-200:]}"


SOURCES = [
    *("batchpid/**/*.[phc]*", "sim/**/*.[phc]*", "bench/*.py", "examples/*.py", "tests/**/*.py"),
    *("assets/*", "Makefile", "pyproject.toml", "setup.py", ".ci/*"),
]
FOREIGN = """
ActuatorCfg DCMotorCfg PDJointPosControllerConfig max_effort mjDSBL_CONSTRAINT
first_robot zero_qpos pid_qf get_joints viewer sim_freq control_freq pd_joint_pos pd_joint_delta_pos
_load_scene balance_passive_force proportional_on_measurement error_map set_auto_mode last_output
gym_env_vectorize_mode impratio noslip_iterations auth verifies ulimit jax_numpy_rank_promotion
batchpid_reset BATCHPID_SOAK_ arm_
"""
"""Names of other programs, and parts of names."""


def test_names_in_the_text_are_those_of_the_code():
    """What is gone is named nowhere."""
    known = {*FOREIGN.split()}
    for path in (path for pattern in SOURCES for path in ROOT.glob(pattern) if path.is_file()):
        known |= {path.stem, *re.findall(r"[A-Za-z_]\w+", path.read_text(errors="ignore"))}
    for page in {*TEXTS} - {ROOT / "CHANGELOG.md"}:
        text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
        named = {
            word
            for span in re.findall(r"`([^`\n]+)`", text)
            for word in re.findall(r"[A-Za-z_]\w{3,}", span)
        }
        assert named - known == set(), page


@pytest.mark.parametrize("page", TEXTS, ids=name)
def test_every_link_has_a_target(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    assert not re.findall(r"`[\w-]+\.md`", text), "a page is named without a link"
    for target, anchor in re.findall(r"\]\(([^)#\s]+)(?:#([\w-]+))?\)", text):
        if re.match(r"\w+:", target):
            continue
        path = page.parent / target
        assert path.exists(), target
        titles = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE) if anchor else []
        assert not anchor or anchor in [
            re.sub(r"[^\w-]", "", title.lower().replace(" ", "-")) for title in titles
        ]


def test_the_pictures_of_the_readme_are_light():
    for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / target).stat().st_size < 400_000, target


def test_every_make_target_in_the_text_exists():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in TEXTS:
        assert set(re.findall(r"`make ([a-z-]+)\b", page.read_text())) <= targets, page


def test_every_page_is_in_the_index():
    index = (ROOT / "docs/README.md").read_text()
    assert all(
        f"({page.name})" in index for page in ROOT.glob("docs/*.md") if page.name != "README.md"
    )


@pytest.mark.parametrize("page", pages_with("python"), ids=name)
def test_python_blocks_run(page, tmp_path, monkeypatch, capsys, request):
    monkeypatch.chdir(tmp_path)
    if "import jax" in page.read_text() and importlib.util.find_spec("jax"):
        request.getfixturevalue("quick_compilation")
    write(tmp_path, TWO_JOINTS, "two.urdf")
    if page.name != "README.md":
        monkeypatch.setattr(batchpid.sim, "Runner", partial(Runner, workers=0))
    shorter = SHORTER_CODE | ({'"panda"': '"two.urdf"'} if name(page) in ON_TWO_JOINTS else {})
    namespace = {"__name__": "__main__"}
    for match in blocks(page, "python"):
        if missing(match):
            continue
        line = page.read_text()[: match.start("code")].count("\n")
        code = match["code"]
        for pattern, size in shorter.items():
            code = re.sub(pattern, size, code)
        exec(compile("\n" * line + code, page, "exec"), namespace)


@pytest.mark.parametrize("page", TEXTS, ids=name)
def test_commands_in_the_text_have_flags_that_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    arguments = [shlex.split(found) for found in re.findall(r"`batchpid (\w+ [^`]+)`", text)]
    arguments += [
        ["demo", *shlex.split(found)]
        for found in re.findall(r"`make demo ARGS=[\"'](.*)[\"']`", text)
    ]
    for words in arguments:
        parse(words)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("page", pages_with("sh"), ids=name)
def test_commands_run(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_files()
    for words in shell_lines(page):
        run(words)


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler")
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "c")], ids=name)
def test_c_blocks_compile_with_the_files_that_the_commands_write(
    page, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for match in blocks(page, "sh", "c"):
        if match["language"] == "sh":
            for line in match["code"].splitlines():
                if "export" in line:
                    run(shlex.split(line, comments=True))
        else:
            (tmp_path / "block.c").write_text(match["code"])
            flags = [
                "-std=c99",
                "-Wall",
                "-Wextra",
                "-Werror",
                "-Wno-unused-function",
                "-fsyntax-only",
            ]
            subprocess.run(["cc", *flags, "block.c"], check=True)


def write_files():
    """Write the files that the commands of all pages may read."""
    panda = Robot.load("panda")
    shutil.copy(panda.path, "arm.urdf")
    Path("arm.xml").write_text(MJCF)
    Path("payload.yaml").write_text("payload: {uniform: [0, 0.5]}")
    bp.save_params("gains.yaml", panda.params(), panda.joint_names)
    bp.save_actuators(
        "motors.yaml", bp.make_actuators(panda.dof, command_delay=0.005), panda.joint_names
    )


def run(words):
    while re.fullmatch(r"[A-Z_]+=\S*", words[0]):  # a variable of the environment
        words = words[1:]
    program, *rest = words
    if program == "make":
        assert re.search(rf"^{rest[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE), words
    elif program == "pip":
        assert rest[0] == "install"
        extras = re.findall(r"\[(.*?)\]", rest[-1])
        project = (ROOT / "pyproject.toml").read_text()
        assert all(
            re.search(rf"^{name} = \[", project, re.MULTILINE)
            for part in extras
            for name in part.split(",")
        )
    elif program == "python":
        files = rest[2:] if rest[:2] == ["-m", "pytest"] else rest[:1]
        assert files, words
        assert all((ROOT / file).is_file() for file in files), words
    else:
        assert program == "batchpid", words
        command(*rest)


def command(name, *flags):
    assert name in COMMANDS
    if name in ONLY_PARSED:
        parse([name, *flags])
        return
    if name == "view" and importlib.util.find_spec("viser") is None:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # findings of the preflight
        shorter = SHORTER.get(name, [])
        if "--trajectory" in flags:  # it lasts as long as its file
            shorter = shorter[: shorter.index("--seconds")]
        assert main([name, *flags, *shorter]) in (0, 3, None)  # 3: so short a run does not settle
