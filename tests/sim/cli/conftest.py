from __future__ import annotations

from collections.abc import Callable

import pytest

from batchpid.sim.cli import main


@pytest.fixture(autouse=True)
def working_folder(
    tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run each test in an empty folder, so that it neither uses nor adds files of the checkout,
    such as out/.
    """
    monkeypatch.chdir(tmp_path_factory.mktemp("working"))


@pytest.fixture
def batchpid(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Function that runs a command line in this process and returns (exit status, stdout,
    stderr).
    """

    def run(*arguments: object) -> tuple[int, str, str]:
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as exit:  # tyro, for --help and bad flags
            status = exit.code if isinstance(exit.code, int) else 1
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return run
