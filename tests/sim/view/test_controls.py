"""Requests of the page: bounded, and none ends the run."""

from batchpid.errors import InvalidArgumentError
from batchpid.sim.view.panel import MAX_REQUESTS, Requests


def test_requests_run_in_order_and_one_that_fails_is_named():
    done, refused = [], []
    requests = Requests(refused.append)

    def fail():
        raise InvalidArgumentError("kp", "is odd", remedy="try another")

    for request in (lambda: done.append(1), fail, lambda: requests.put(lambda: done.append(3)), lambda: done.append(2)):
        requests.put(request)
    requests.run()
    assert done == [1, 2]
    assert refused == ["kp: is odd; try another"]
    requests.run()
    assert done == [1, 2, 3]


def test_more_requests_than_fit_are_refused():
    done, refused = [], []
    requests = Requests(refused.append)
    for number in range(MAX_REQUESTS + 5):
        requests.put(lambda number=number: done.append(number))
    requests.run()
    assert done == list(range(MAX_REQUESTS))
    assert len(refused) == 5
