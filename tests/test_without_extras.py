"""README and index followed without any extra: each command and program runs, or names the extra
that it needs.
"""

import json
import re
import subprocess
import sys
import tomllib

import pytest
from packaging.requirements import Requirement
from pages import ROOT, SHORTER, SHORTER_CODE, TWO_JOINTS, blocks, shell_lines
from tiny_urdf import write

README, INDEX = ROOT / "README.md", ROOT / "docs/README.md"
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
FOR_USERS = set(re.findall(r"\[(.*)\]", EXTRAS["all"][0])[0].split(","))
MODULES = {"pycollada": "collada", "imageio-ffmpeg": "imageio_ffmpeg"}
"""Name of a package's module, where it is another than the package's."""
NEEDED = {"tune": "tune", "view": "view"}
"""Commands of the two pages that need an extra."""
SIZES = SHORTER | {"compare": ["--moves", "1"]}
PROGRAM = """
import contextlib, io, json, sys, warnings
from importlib.machinery import PathFinder
import batchpid as bp
warnings.simplefilter("ignore")
absent, commands, programs = json.load(sys.stdin)
find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *place: None if name.partition(".")[0] in absent else find(name, *place)
from batchpid.sim import Robot
from batchpid.sim.cli import main
panda = Robot.load("panda")
open("arm.urdf", "w").write(open(panda.path).read())
results = []
for words in commands:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as errors:
        results.append((words, main(words), errors.getvalue()))
    if words[0] == "tune":  # it would have written them
        bp.save_params("gains.yaml", panda.params(), panda.joint_names)
for program in programs:
    with contextlib.redirect_stdout(io.StringIO()):
        exec(program, {})
print(json.dumps(results))
"""


def modules_of_extras():
    """Return the modules of all packages of the users' extras."""
    packages = {Requirement(need).name for extra in FOR_USERS for need in EXTRAS[extra]} - {
        "batchpid"
    }
    return sorted(MODULES.get(package, package) for package in packages)


def test_the_index_lists_every_extra_for_users():
    rows = re.findall(r"^\| (.*) \|.*\|.*[GM]B \|$", INDEX.read_text(), re.MULTILINE)
    assert [row.strip("`") for row in rows if row != "none"][-1] == "all"
    assert {row.strip("`") for row in rows} == {"none", "all"} | FOR_USERS


def test_the_base_contains_no_package_of_an_extra():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    base = {Requirement(need).name for need in project["dependencies"]}
    assert base.isdisjoint(Requirement(need).name for extra in FOR_USERS for need in EXTRAS[extra])


@pytest.mark.slow
def test_each_command_and_program_runs_or_names_its_extra(tmp_path):
    lines = [
        words[1:]
        for page in (README, INDEX)
        for words in shell_lines(page)
        # The page has no log to identify motors from.
        if words[0] == "batchpid" and words[1] != "identify"
    ]
    sizes = [[] if "--trajectory" in words else SIZES.get(words[0], []) for words in lines]
    commands = [[*words, *size] for words, size in zip(lines, sizes, strict=True)]
    (tmp_path / "robots").mkdir()
    write(tmp_path / "robots", TWO_JOINTS, "two.urdf")
    programs = [match["code"] for page in (README, INDEX) for match in blocks(page, "python")]
    for pattern, size in (SHORTER_CODE | {"workers=2": "workers=0"}).items():
        programs = [re.sub(pattern, size, program) for program in programs]
    assert len(commands) >= 10
    assert programs
    given = json.dumps([modules_of_extras(), commands, programs])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], input=given, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for words, status, errors in json.loads(done.stdout):
        extra = "jax" if "jax" in words else NEEDED.get(words[0])
        remedy = (
            f"install it with: pip install '.[{extra}]' in the checkout of batchpid\n"
            if extra
            else ""
        )
        assert (status or 0) == (2 if extra else 0), (words, errors)
        assert errors.endswith(remedy), (words, errors)
