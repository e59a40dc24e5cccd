"""Messages arrive whole and in order, and whoever waits for the other side can end the wait."""

from __future__ import annotations

import socket
import threading

import numpy as np
import pytest

from sim.workers.channel import Channel


class Enough(Exception):
    pass


@pytest.fixture
def ends():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


def give_up():
    raise Enough


def messages():
    random = np.random.default_rng(0)
    sizes = [0, 1, 13, 4088, 4096, 5000, 70_000, 3_000_000, 1]
    return [random.bytes(size) for size in sizes]


@pytest.mark.parametrize("patient", [True, False])
def test_messages_of_any_size_arrive_as_they_were_sent(ends, patient):
    first, second = Channel(ends[0], (lambda: None) if patient else None), Channel(ends[1])

    def echo():
        for _ in messages():
            second.send(second.receive())

    thread = threading.Thread(target=echo)
    thread.start()
    for message in messages():
        first.send(message)
        assert first.receive() == message
    thread.join()


def test_some_messages_at_once(ends):
    first, second = Channel(ends[0], give_up), Channel(ends[1])
    for text in (b"a", b"", b"bc"):
        second.send(text)
    assert [first.receive() for _ in range(3)] == [b"a", b"", b"bc"]


def test_waits_can_be_ended(ends):
    channel = Channel(ends[0], give_up)
    with pytest.raises(Enough):
        channel.receive()
    with pytest.raises(Enough):
        channel.send(bytes(10_000_000))  # which nobody takes


def test_a_gone_other_side_is_told(ends):
    channel = Channel(ends[0], give_up)
    ends[1].sendall(b"half a h")
    ends[1].close()
    with pytest.raises(EOFError):
        channel.receive()
    with pytest.raises(OSError, match="pipe"):
        channel.send(bytes(10))
    channel.close()
    channel.close()
