"""Who may open the page: only a browser with the token in its address, at this server, from no
other site.
"""

import urllib.error
import urllib.request

import pytest

from batchpid.errors import BatchPIDError
from batchpid.sim.view import LiveSimulation

pytest.importorskip("viser")
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from batchpid.sim.view.page import Gate


@pytest.fixture
def view(panda, serve):
    return serve(LiveSimulation(panda, 1, workers=0, physics="fast", period=0.1))


def status(url, **headers):
    try:
        with urllib.request.urlopen(
            urllib.request.Request(url, headers=headers), timeout=20
        ) as response:
            return response.status
    except urllib.error.HTTPError as error:
        return error.code


def test_a_page_opens_with_the_address_that_was_printed_and_otherwise_gets_403(view):
    base, port = view.url.rsplit("/", 2)[0], view.port
    assert status(view.url) == status(view.url.rstrip("/")) == 200
    for host in (f"localhost:{port}", "localhost:9000"):  # 9000: through a tunnel
        assert status(view.url, Host=host, Origin=f"http://{host}") == 200
    for origin in ("http://evil.example", "null", f"http://127.0.0.1:{port + 1}", ""):
        assert status(view.url, Origin=origin) == 403
    for host in (
        "evil.example",
        f"evil.example:{port}",
        "127.0.0.1.evil.example",
        "10.0.0.1",
        "[",
        "",
    ):
        assert status(view.url, Host=host) == 403
    for path in ("", "/", "/index.html", "/" + "x" * 22 + "/", view.url[len(base) : -2], "/%"):
        assert status(base + path) == 403


@pytest.mark.parametrize(
    ("cut", "options"),
    [
        (True, {}),
        (False, {"origin": "http://evil.example"}),
        (False, {"additional_headers": {"Host": "evil.example"}}),
    ],
)
def test_so_does_a_web_socket(view, cut, options):
    url = view.url.replace("http", "ws")
    with pytest.raises(InvalidStatus) as error:
        connect(url.rsplit("/", 2)[0] if cut else url, **options)
    assert error.value.response.status_code == 403


def test_a_viser_that_starts_its_server_in_another_way_is_refused():
    class Other:
        stopped = False

        def stop(self):
            Other.stopped = True

    gate = Gate(0)
    with gate.socket, pytest.raises(BatchPIDError, match="this version of viser"):
        gate.start(Other)
    assert Other.stopped
