"""Errors: their message, and their way across process borders."""

import copy
import pickle

import pytest

from batchpid.errors import (
    InvalidArgumentError,
    MissingDependencyError,
    RobotNotFoundError,
    WorkerError,
)


def test_a_message_names_argument_joint_env_value_and_remedy():
    error = InvalidArgumentError(
        "kp", "is negative", joint="elbow", env=3, value=-1.0, remedy="use numbers >= 0"
    )
    assert str(error) == "kp, joint 'elbow', env 3: is negative (got -1.0); use numbers >= 0"


def test_a_large_value_is_shortened():
    message = str(
        InvalidArgumentError(
            "robot", "must be a name", value=[list(range(10**4))] * 99, remedy="pass a name"
        )
    )
    assert len(message) < 300
    assert "..." in message


@pytest.mark.parametrize(
    "error",
    [
        InvalidArgumentError(
            "kp", "is negative", joint="elbow", env=3, value=-1.0, remedy="use numbers >= 0"
        ),
        MissingDependencyError("jax", "backend='jax'", "jax"),
        RobotNotFoundError("no robot of that name"),
        WorkerError("worker 1 died"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_survive_pickle_and_copy_with_their_fields(error):
    for again in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
        assert type(again) is type(error)
        assert str(again) == str(error)
        assert again.__dict__ == error.__dict__
