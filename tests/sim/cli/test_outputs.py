"""Output files: no command replaces one without --force, and default names describe the content."""

import re

import pytest
from commands_that_write import SHORT, WORDS, output, output_flags


@pytest.fixture
def empty_pictures(monkeypatch):
    """Make commands write empty files in place of pictures: only their names matter."""
    monkeypatch.setattr("batchpid.sim.plots.step_responses", lambda *_, **__: None)
    monkeypatch.setattr(
        "batchpid.sim.plots.save",
        lambda _, path: (path.parent.mkdir(exist_ok=True), path.touch()) and path,
    )


@pytest.mark.parametrize("folder", ["", "missing/"])
@pytest.mark.parametrize(("name", "flag"), output_flags())
def test_an_output_that_exists_or_has_no_folder_is_refused_before_the_run(
    name, flag, folder, files, batchpid, tmp_path, monkeypatch
):
    monkeypatch.chdir(files)
    path = tmp_path / f"{folder}{output(name, flag)}"
    if not folder:
        path.write_text("kept")
    status, said, complaint = batchpid(*WORDS[name], f"--{flag}", path)
    assert (status, said) == (2, "")
    problem = "has no folder" if folder else "exists already"
    remedy = (
        f"mkdir -p {path.parent}" if folder else "add --force to replace it, or .* another name"
    )
    assert re.search(rf"^batchpid: {flag}: {problem} .*{remedy}\n", complaint, re.MULTILINE)
    assert [each.name for each in tmp_path.iterdir()] == ([] if folder else [path.name])
    assert folder or path.read_text() == "kept"


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
