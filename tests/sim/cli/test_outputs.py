"""Output files: no command replaces one without --force, and default names describe the content."""

from __future__ import annotations

import dataclasses
import os

import pytest
from commands_that_write import SHORT, WORDS, output, output_flags

from batchpid.sim.cli.commands import COMMANDS


@pytest.fixture
def empty_pictures(monkeypatch):
    """Make commands write empty files in place of pictures: only their names matter."""
    for name in ("step_responses", "efforts"):
        monkeypatch.setattr(f"batchpid.sim.plots.{name}", lambda *_, **__: None)
    monkeypatch.setattr(
        "batchpid.sim.plots.save",
        lambda _, path: (path.parent.mkdir(exist_ok=True), path.touch()) and path,
    )


@pytest.mark.parametrize(("name", "flag"), output_flags())
def test_an_existing_output_is_refused_before_the_run(
    name, flag, files, batchpid, tmp_path, monkeypatch
):
    monkeypatch.chdir(files)
    (path := tmp_path / output(name, flag, "kept")).write_text("kept")
    others = [
        word
        for command, each in output_flags()
        if command == name and each not in (flag, "out")
        for word in (f"--{each}", tmp_path / output(name, each))
    ]
    status, said, complaint = batchpid(*WORDS[name], *others, f"--{flag}", path)
    assert (status, said) == (2, "")
    assert complaint.splitlines()[-1].startswith(f"batchpid: {flag}: exists already (got '{path}')")
    assert "--force" in complaint
    assert "another name" in complaint
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    assert path.read_text() == "kept"


@pytest.mark.slow
@pytest.mark.usefixtures("empty_pictures")
def test_default_names_say_what_they_show(files, batchpid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.h5").write_bytes((files / "run.h5").read_bytes())
    (tmp_path / "run.png").write_text("kept")
    for words in ((), ("--kind", "efforts")):
        status, _, complaint = batchpid("plot", "run.h5", *words)
        assert status == 0, complaint
        status, _, complaint = batchpid("plot", "run.h5", *words)
        assert "exists already" in complaint
        assert batchpid("plot", "run.h5", *words, "--force")[0] == 0
    names = {"run.h5", "run.png", "run-responses.png", "run-efforts.png"}
    assert {path.name for path in tmp_path.iterdir()} == names
    assert (tmp_path / "run.png").read_text() == "kept"


@pytest.mark.usefixtures("empty_pictures")
def test_the_demo_can_be_repeated_for_another_robot_and_with_force(batchpid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert batchpid("demo", *SHORT)[0] == 0
    status, said, complaint = batchpid("demo", *SHORT)
    assert (status, said) == (2, "")
    assert "out/panda-demo.png" in complaint
    assert batchpid("demo", *SHORT, "--force")[0] == 0
    assert batchpid("demo", "jaco2", *SHORT)[0] == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "panda-demo.png",
        "jaco2-demo.png",
    }


INPUTS = {
    "gains": "a.yaml",
    "actuators": "a.yaml",
    "randomize": "a.yaml",
    "trajectory": "m.csv",
}
"""Flags of files to read, besides those in WORDS."""


@pytest.mark.parametrize("make", [os.symlink, os.link])
@pytest.mark.parametrize(("name", "flag"), output_flags())
def test_a_file_that_a_command_reads_is_never_replaced(
    name, flag, make, files, batchpid, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    names = {field.name for field in dataclasses.fields(COMMANDS[name].record())}
    words = [
        *WORDS[name],
        *(word for each, file in INPUTS.items() if each in names for word in (f"--{each}", file)),
    ]
    read = {file for file in words if str(file).endswith((".urdf", ".yaml", ".csv", ".h5"))}
    for file in read:
        (tmp_path / file).write_text("kept")
    for file in read:
        path = tmp_path / output(name, flag)
        make(tmp_path / file, path)
        status, said, complaint = batchpid(*words, f"--{flag}", path, "--force")
        assert (status, said, f"batchpid: {flag}: is a file to read" in complaint) == (
            2,
            "",
            True,
        ), complaint
        assert (tmp_path / file).read_text() == "kept"
        path.unlink()
