"""Messages arrive whole and in order, and a callback can end the wait for the other side."""

from __future__ import annotations

import signal
import socket
import threading

import numpy as np
import pytest

from batchpid.sim.workers.exchange import Channel


class WaitEnded(Exception):
    pass


@pytest.fixture
def ends():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield ours, theirs


def end_wait():
    raise WaitEnded


def messages():
    random = np.random.default_rng(0)
    sizes = [0, 1, 13, 4088, 4096, 5000, 70_000, 3_000_000, 1]
    return [random.bytes(size) for size in sizes]


@pytest.mark.parametrize("on_wait", [None, lambda: None])
def test_messages_of_any_size_arrive_unchanged(ends, on_wait):
    first, second = Channel(ends[0], on_wait), Channel(ends[1])

    def echo():
        for _ in messages():
            second.send(second.receive())

    thread = threading.Thread(target=echo)
    thread.start()
    for message in messages():
        first.send(message)
        assert first.receive() == message
    thread.join()


def test_messages_sent_together_are_received_one_by_one(ends):
    first, second = Channel(ends[0], end_wait), Channel(ends[1])
    for text in (b"a", b"", b"bc"):
        second.send(text)
    assert [first.receive() for _ in range(3)] == [b"a", b"", b"bc"]


def test_the_callback_ends_a_wait(ends):
    channel = Channel(ends[0], end_wait)
    with pytest.raises(WaitEnded):
        channel.receive()
    with pytest.raises(WaitEnded):
        channel.send(bytes(10_000_000))  # which nobody takes


def test_a_closed_other_side_raises(ends):
    channel = Channel(ends[0], end_wait)
    ends[1].sendall(b"half a h")
    ends[1].close()
    with pytest.raises(EOFError):
        channel.receive()
    with pytest.raises(OSError, match="pipe"):
        channel.send(bytes(10))
    channel.close()
    channel.close()


def test_the_end_of_the_other_side_is_an_error_with_the_default_of_sigpipe_too(ends):
    before = signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        ends[1].close()
        with pytest.raises(BrokenPipeError):
            Channel(ends[0]).send(b"message")
    finally:
        signal.signal(signal.SIGPIPE, before)
