"""A history matches the inputs and is intact, or an error names the fault."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from batchpid.errors import InvalidArgumentError
from batchpid.sim.identification.fit import Step
from batchpid.sim.identification.fit_history import History, State
from batchpid.sim.tuning.history import HistoryFile

SETTINGS = {"robot": "arm", "seed": 3, "weights": {"itae": 1.0}}
STATE = State(Step(np.array([0.1, 0.2]), 5, np.array([0.0, 0.2]), np.inf), ((0, [0.1, 0.3]),))


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "fit.json"
    History(path, SETTINGS).write(STATE)
    return path


def test_a_state_is_read_as_it_was_written(path, tmp_path):
    found = History(path, SETTINGS).state(2, 25, 2)
    assert repr(found) == repr(STATE)
    assert History(tmp_path / "other.json", SETTINGS).state(2, 25, 2) is None
    assert History(None, SETTINGS).state(2, 25, 2) is None


def test_inputs_that_differ_are_named(path):
    other = {**SETTINGS, "seed": 4, "weights": {"itae": 2.0}, "added": None}
    with pytest.raises(InvalidArgumentError, match=r"another fit \(seed, weights differ\)"):
        History(path, {**SETTINGS, "seed": 4, "weights": {"itae": 2.0}}).state(2, 25, 2)
    with pytest.raises(InvalidArgumentError, match=r"added, seed, weights differ"):
        History(path, other).state(2, 25, 2)


def test_a_state_that_fits_no_fit_is_refused(path):
    for unknowns, evaluations, problems in ((3, 25, 2), (2, 4, 2), (2, 25, 0)):
        with pytest.raises(InvalidArgumentError, match="not a history of a fit"):
            History(path, SETTINGS).state(unknowns, evaluations, problems)
    for state in (7, {}, {"theta": 1}, [], {"theta": [1], "left": 1e999, "last": [1], "cost": 0, "done": 4}):
        HistoryFile(path, "fit", SETTINGS).write(state)
        with pytest.raises(InvalidArgumentError, match="not a history of a fit"):
            History(path, SETTINGS).state(2, 25, 2)


def test_an_edited_state_is_refused(path):
    document = json.loads(path.read_text())
    document["state"]["theta"][0] = 0.7
    path.write_text(json.dumps(document))
    with pytest.raises(InvalidArgumentError, match="was damaged or edited"):
        History(path, SETTINGS).state(2, 25, 2)


HOSTILE = st.one_of(
    st.binary(max_size=40),
    st.sampled_from([b"", b"[" * 100_000, b"\xff", b"9" * 5000, b'{"settings": ' * 9000, b"NaN", b"[1e999]"]),
    st.builds(
        lambda key, value: json.dumps({"settings": SETTINGS, "state": {}, "digest": "", key: value}).encode(),
        st.sampled_from(["settings", "state", "digest"]),
        st.none()
        | st.integers()
        | st.floats()
        | st.text()
        | st.lists(st.integers())
        | st.dictionaries(st.text(), st.none()),
    ),
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(HOSTILE)
def test_hostile_content_ends_in_one_error(path, content):
    path.write_bytes(content)
    with pytest.raises(InvalidArgumentError, match="not a history of a fit"):
        History(path, SETTINGS).state(2, 25, 2)


def test_a_folder_is_no_history(tmp_path):
    with pytest.raises(InvalidArgumentError, match="not a history of a search"):
        HistoryFile(tmp_path, "search", SETTINGS).read()
