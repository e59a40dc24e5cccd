"""Strangers at the page: foreign sites, no token, values out of range, damaged messages, many clients."""

import asyncio
import math
import socket
import threading
import urllib.error
import urllib.request
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from batchpid.errors import InvalidArgumentError
from batchpid.sim.view import LiveSimulation, View

viser = pytest.importorskip("viser")
import msgspec  # noqa: E402
import zstandard  # noqa: E402
from websockets.asyncio.client import connect  # noqa: E402
from websockets.exceptions import InvalidStatus  # noqa: E402

from batchpid.sim.view.address import listen, resolve  # noqa: E402
from batchpid.sim.view.gate import MAX_BYTES, Gate, check_message  # noqa: E402

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (1.0, 1.0, 1.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 100,
    "image_width": 100,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}
CLICK = {
    "type": "SceneNodeClickMessage",
    "name": "/robots/0",
    "instance_index": 1,
    "ray_origin": (0.0, 0.0, 0.0),
    "ray_direction": (0.0, 0.0, 1.0),
    "screen_pos": (0.5, 0.5),
    "modifier": None,
}
UPDATE = {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 1.0}}
PARTS = ("type", *CAMERA, *CLICK, *UPDATE)
ENCODED = [msgspec.msgpack.encode(message) for message in (CAMERA, CLICK, UPDATE)]
UNHURRIED = {"ping_interval": None, "open_timeout": None}  # of a socket, for a loaded machine
BAD_VALUES = [
    ("kp", -1, "kp: out of range (got -1.0); use a number from 0"),
    ("kp", 1e9, "kp: out of range"),
    ("kp", math.nan, "value"),
    ("kp", "abc", "could not convert string to float: 'abc'"),
    ("kp", [1.0], "got `array`"),
    ("Joint", "bogus", "Joint: unknown option (got 'bogus')"),
    ("Joint", "x" * 1000, "length <= 200"),
    ("Robot", -9, "Robot: out of range (got -9.0)"),
    ("Speed", 0, "Speed: out of range (got 0.0)"),
    ("Motion", "Explode", "Motion: unknown option"),
    ("joint1 [rad]", math.inf, "value"),
    ("Payload [kg]", 1e300, "Payload [kg]: out of range"),
]


class Page:
    """Page without a browser: a web socket, the controls by label, and the reported refusals."""

    def __init__(self, view):
        self.address = view.url.replace("http", "ws")
        self.controls, self.notices = {}, []

    async def __aenter__(self):
        protocols = [f"viser-v{viser.__version__}"]
        self.socket = await connect(self.address, subprotocols=protocols, max_size=None, **UNHURRIED)
        self._task = asyncio.create_task(self._listen())
        await self.send(CAMERA)
        await until(lambda: "Push along" in self.controls)
        return self

    async def __aexit__(self, *_):
        await self.socket.close()
        await asyncio.gather(self._task, return_exceptions=True)

    async def _listen(self):
        async for data in self.socket:
            size = int.from_bytes(data[8:16], "little")
            batch = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]))
            for message in batch["messages"]:
                props = message.get("props", {})
                if message["type"] == "NotificationShowMessage":
                    self.notices.append(props["body"])
                elif "label" in props:
                    self.controls[props["label"]] = message["uuid"]

    async def send(self, message):
        await self.socket.send(message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message))

    async def change(self, label, value):
        await self.send({**UPDATE, "uuid": self.controls[label], "updates": {"value": value}})


async def until(condition, seconds=200):
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.01)


@pytest.fixture
def live(panda):
    return LiveSimulation(panda, 2, workers=0, spread=0.0, physics="fast", period=0.1)


@pytest.fixture
def view(live, serve):
    view = serve(live, port=18200)
    view.panel.frames_left = 0
    return view


def status(url, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=20) as response:
            return response.status
    except urllib.error.HTTPError as error:
        return error.code


def test_pages_of_other_sites_and_requests_without_the_token_get_403(view):
    base = view.url.rsplit("/", 2)[0]
    port = view.port
    assert status(view.url) == status(view.url.rstrip("/")) == 200
    for host in (f"localhost:{port}", "localhost:9000", f"[::1]:{port}"):  # 9000: through a tunnel
        assert status(view.url, Host=host, Origin=f"http://{host}") == 200
    for origin in ("http://evil.example", "null", f"http://127.0.0.1:{port + 1}", ""):
        assert status(view.url, Origin=origin) == 403
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", "10.0.0.1", "[", ""):
        assert status(view.url, Host=host) == 403
    for path in ("", "/", "/index.html", "/" + "x" * 22 + "/", view.url[len(base) : -2], "/%"):
        assert status(base + path) == 403

    async def opening(url, **options):
        with pytest.raises(InvalidStatus) as refused:
            await connect(url.replace("http", "ws"), **options)
        return refused.value.response.status_code

    assert asyncio.run(opening(base)) == 403
    assert asyncio.run(opening(view.url, origin="http://evil.example")) == 403
    assert asyncio.run(opening(view.url, additional_headers={"Host": "evil.example"})) == 403


def test_which_hosts_are_this_server():
    for bound, ours, foreign in (
        ("127.0.0.1", ("127.0.0.1", "LOCALHOST:80", "[::1]:1"), ("10.0.0.1", "a.localhost", socket.gethostname())),
        (
            "0.0.0.0",
            ("10.0.0.1:8080", "localhost", socket.gethostname(), socket.gethostname() + ".lab.example:1"),
            ("evil.example", ""),
        ),
    ):
        gate = Gate(bound, 18210, print)
        gate.start(lambda: viser.ViserServer(verbose=False)).stop()
        path = gate.url.partition(f":{gate.port}")[2]
        assert [gate.problem([host], [f"http://{host}"], path) for host in ours] == [None] * len(ours)
        assert all("another name" in gate.problem([host], [], path) for host in foreign)
        assert gate.problem([], [], path)
        assert gate.problem([ours[0]] * 2, [], path)
        assert gate.problem([ours[0]], [f"http://{ours[0]}"] * 2, path)


def test_bad_values_are_refused_with_a_notice_and_good_ones_act(live, view, monkeypatch):
    monkeypatch.setattr("batchpid.sim.view.page.NOTICE_SECONDS", 0.0)

    async def visit():
        async with Page(view) as page, Page(view) as other:
            before = live.gains["pid"].params
            for label, value, said in BAD_VALUES:
                page.notices.clear()
                await page.change(label, value)
                await until(lambda said=said: any(said in notice for notice in page.notices))
            await page.send({**CLICK, "instance_index": -9})
            await until(lambda: "robot: out of range (got -9)" in page.notices[-1])
            assert live.gains["pid"].params is before
            assert (view.panel.env, view.panel.joint, view.panel.speed, live.payload) == (0, 0, 1.0, 0.0)
            await page.send(CLICK)
            await other.change("kp", 33)
            await other.change("Motion", "Run")
            await until(lambda: view.panel.env == 1 and live.time > 0.2)
            assert live.gains["pid"].params.kp[0, 0] == 33.0
            assert other.notices

    asyncio.run(visit())


def hostile(count, controls, seed):
    """Return messages that no page sends, most of them near to one that a page sends."""
    random = np.random.default_rng(seed)
    values = [-1, math.nan, math.inf, 1e300, "bogus", "", None, [], {}, True, -9, 2**63, b"x", "x" * 3000, [[[[]]]]]
    keys = ["value", "min", "max", "options", "update_cb", "uuid", "gui_api", "removed", "sync_cb"]
    kinds = ["ShareUrlRequest", "FileTransferStartUpload", "ResetGuiMessage", "GetRenderResponseMessage", "", 7, None]
    for number in range(count):
        value = values[random.integers(len(values))]
        uuid = str(random.choice(list(controls.values())))
        update = {**UPDATE, "uuid": uuid, "updates": {str(random.choice(keys)): value}}
        match number % 6:
            case 0:
                yield {**UPDATE, "uuid": uuid, "updates": {"value": value}}
            case 1:
                yield update
            case 2:
                yield {**CLICK, "instance_index": value}
            case 3:
                yield {**update, "type": kinds[random.integers(len(kinds))]}
            case 4:
                data = bytearray(msgspec.msgpack.encode(update))
                data[random.integers(len(data))] ^= 1 << random.integers(8)
                yield bytes(data)
            case _:
                yield random.bytes(random.integers(0, 200))


def attack(view, live, messages, clients):
    """Send hostile messages, some too large, with many clients and connections that never say anything."""

    async def visit():
        idle = [socket.create_connection(("127.0.0.1", view.port)) for _ in range(10)]
        idle[0].send(b"GET / HTTP/1.1\r\nHost: ")
        idle[1].send(b"\x00" * 1000)
        idle[2].close()
        async with Page(view) as page:
            others = [Page(view) for _ in range(clients - 1)]
            for other in others:
                other.socket = await connect(other.address, subprotocols=[f"viser-v{viser.__version__}"], **UNHURRIED)
            for number, message in enumerate(hostile(messages, page.controls, seed=0)):
                await page.send(message)
                if number % 50 == 0:  # closes that connection
                    await others[number // 50].socket.send(b"x" * (MAX_BYTES + 1))
                    await others[number // 50].socket.wait_closed()
            await page.change("Motion", "Run")
            start = live.time
            await until(lambda: live.time > start + 3 * live.period)
            await page.change("kp", 33)
            await until(lambda: live.gains["pid"].params.kp[0, view.panel.joint] == 33.0)
            assert page.notices
            await asyncio.gather(*(other.socket.close() for other in others))
        for connection in idle:
            connection.close()

    asyncio.run(visit())
    assert all(np.isfinite(leaf).all() for leaf in live.gains["pid"].values.values())


@pytest.mark.parametrize(("messages", "clients"), [(60, 5), pytest.param(500, 50, marks=pytest.mark.slow)])
def test_hostile_messages_and_many_clients_do_not_end_the_run(live, view, messages, clients):
    attack(view, live, messages, clients)


def test_a_connection_opened_in_advance_ends_with_the_page(live):
    view = View(live, port=18250)
    with socket.create_connection(("127.0.0.1", view.port), timeout=5) as connection:
        assert status(view.url) == 200  # so the one before is known to the server
        view.close()
        with suppress(ConnectionResetError):
            assert connection.recv(1) == b""


def read(data):
    """Refuse a message with our error, or let viser read it."""
    from viser._messages import Message

    try:
        check_message(data)
    except InvalidArgumentError:
        return
    Message.deserialize(data)


nested = st.recursive(
    st.none()
    | st.booleans()
    | st.floats()
    | st.integers(-(2**63), 2**63)
    | st.text(max_size=9)
    | st.binary(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(PARTS) | st.text(max_size=3), inner),
    max_leaves=9,
)


@settings(max_examples=60)
@given(st.binary(max_size=200) | nested.map(msgspec.msgpack.encode))
def test_any_message_is_refused_with_our_error_or_can_be_read_by_viser(data):
    read(data)


def test_messages_of_the_page_pass_and_any_flipped_bit_is_refused_or_can_be_read():
    check_message(msgspec.msgpack.encode({**UPDATE, "updates": {"value": "joint1"}}))
    for data in ENCODED:
        check_message(data)
        for bit in range(8 * len(data)):
            flipped = bytearray(data)
            flipped[bit // 8] ^= 1 << bit % 8
            read(bytes(flipped))


@pytest.mark.parametrize("host", ["nothing.invalid", "203.0.113.1", "a" * 70, ""])
def test_a_host_that_is_not_of_this_machine_is_named(host):
    with pytest.raises(InvalidArgumentError, match=r"host: cannot be (resolved|listened on)"):
        listen(host, 18220)


def test_a_port_in_use_is_skipped():
    first, second = listen("127.0.0.1", 18230), listen("localhost", 18230)
    with first, second:
        assert second.getsockname()[1] > first.getsockname()[1]
    assert resolve("::1")[4][0] == "::1"


def test_a_viser_that_starts_its_server_in_another_way_is_refused():
    from batchpid.errors import BatchPIDError

    stopped = threading.Event()

    class Other:
        stop = stopped.set

    gate = Gate("127.0.0.1", 18240, print)
    with pytest.raises(BatchPIDError, match="this version of viser"):
        gate.start(Other)
    assert stopped.is_set()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", gate.port))
