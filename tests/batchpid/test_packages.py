"""Ctrl-C while a package is imported is not lost."""

import pytest

from batchpid.io.files import imported, uninterrupted

SWALLOWS = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
    import json
except BaseException:
    json = None
"""


def test_ctrl_c_takes_effect_when_the_import_is_complete(tmp_path, monkeypatch):
    (tmp_path / "swallows.py").write_text(SWALLOWS)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        imported("swallows")
    assert imported("swallows").json is not None
    with pytest.raises(ImportError), uninterrupted():
        imported("no_such_package")
