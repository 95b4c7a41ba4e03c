"""Results over the network: OpenIGTLink, WebSocket and UDP, on loopback, with clients that misbehave."""

from __future__ import annotations

import asyncio
import json
import math
import shutil
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tubesight.client import Result, results, results_async, subscribe
from tubesight.core import InputError, Status
from tubesight.files.message import ResultMessage, dump_message, message_schema, parse_message
from tubesight.geometry.curve import Arc
from tubesight.geometry.shape import shape_of
from tubesight.outputs.network.access import Access, is_loopback
from tubesight.outputs.network.hub import Hub
from tubesight.outputs.network.messages import result_message
from tubesight.sensor import Reconstruction

pyigtl = pytest.importorskip("pyigtl")
pytest.importorskip("websockets")

from tubesight.outputs.network.igtl_messages import STATE, TIP, pack_result, tip_pose  # noqa: E402
from tubesight.outputs.network.igtl_server import CLIENTS_MAX, IgtlServer  # noqa: E402
from tubesight.outputs.network.udp import UdpSender  # noqa: E402
from tubesight.outputs.network.websocket import WebSocketServer  # noqa: E402

HEADER = struct.Struct("> H 12s 20s II Q Q")
ARC = Arc(np.array([0.006, -0.004]), 120.0)


def good(name: str = "0001", arc: Arc = ARC) -> Reconstruction:
    return Reconstruction(name, Status.OK, ("a note",), shape_of(arc, 0.1), arc, {}, "silhouette", 0.07, {"solve": 1.5})


FAILED = Reconstruction(
    "0002", Status.TIP_NOT_FOUND, ("left: nothing round – \N{GREEK SMALL LETTER THETA}",), None, None, {}, "silhouette"
)


@pytest.fixture
def igtl() -> Iterator[tuple[Hub, IgtlServer]]:
    server = IgtlServer(port=0)
    with Hub([server]) as hub:
        yield hub, server


@pytest.fixture
def web() -> Iterator[tuple[Hub, WebSocketServer]]:
    server = WebSocketServer(Access(), port=0)
    with Hub([server]) as hub:
        yield hub, server


def until(condition: Any, seconds: float = 5.0) -> bool:
    """Wait for something that another thread does."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def connect(server: IgtlServer) -> socket.socket:
    before = len(server.clients)
    client = socket.create_connection(("127.0.0.1", server.port), timeout=5)
    until(lambda: len(server.clients) > before, 1.0)
    return client


def receive(client: socket.socket) -> tuple[str, str, bytes, dict[str, Any]]:
    """Receive one message, check its sum, and return type, device, body and header."""

    def exactly(count: int) -> bytes:
        data = b""
        while len(data) < count:
            more = client.recv(count - len(data))
            assert more, "the server hung up"
            data += more
        return data

    header = exactly(HEADER.size)
    fields = pyigtl.messages.MessageBase.parse_header(header)
    body = exactly(fields["body_size"])
    assert pyigtl.messages.CRC64(body) == HEADER.unpack(header)[-1]
    return fields["message_type"], fields["device_name"], body, fields


# Messages


def test_message_carries_the_numbers_and_fits_its_schema() -> None:
    message = result_message(good(), 7, 12.5)
    parsed = ResultMessage.model_validate(message)
    assert parsed.number == 7 and parsed.time_s == 12.5 and parsed.status == "ok"
    np.testing.assert_allclose(parsed.tip_mm, ARC.at([120.0])[0], atol=1e-4)  # rounded to 1e-4
    # 120 mm times the curvature.
    assert parsed.bending_deg == pytest.approx(math.degrees(120 * math.hypot(0.006, 0.004)), abs=1e-4)
    assert parsed.curve_mm is not None and len(parsed.curve_mm) == 33
    assert parse_message(dump_message(message)) == parsed


def test_message_of_a_failure_has_no_numbers() -> None:
    message = result_message(FAILED, 0)
    parsed = ResultMessage.model_validate(message)
    assert parsed.status == "tip_not_found" and parsed.notes == list(FAILED.notes)
    for name in ("time_s", "tip_mm", "tip_direction", "bending_deg", "length_mm", "sd", "curve_mm", "curve_sd_mm"):
        assert getattr(parsed, name) is None


def test_schema_names_every_key() -> None:
    assert set(message_schema()["properties"]) == set(result_message(good(), 0))


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", "null", '{"format": "tubesight-result/2"}', "[" * 5000, "x" * (2 << 20), b"\xff\xfe"]
)
def test_what_is_no_message_is_refused(text: str | bytes) -> None:
    with pytest.raises(InputError, match="message"):
        parse_message(text)


def test_client_gives_arrays_and_nan() -> None:
    result = Result.of(dump_message(result_message(good(), 3)))
    assert result and result.curve_mm.shape == (33, 3)
    np.testing.assert_allclose(result.curve_mm[-1], result.tip_mm, atol=1e-4)
    failed = Result.of(dump_message(result_message(FAILED, 4)))
    assert not failed and np.isnan(failed.tip_mm).all() and np.isnan(failed.length_mm) and len(failed.curve_mm) == 0


@given(st.floats(-0.03, 0.03), st.floats(-0.03, 0.03))
def test_tip_pose_is_a_rotation_onto_the_tangent(kx: float, ky: float) -> None:
    arc = Arc(np.array([kx, ky]), 100.0)
    pose = tip_pose(result_message(good(arc=arc), 0))
    # Directions are rounded to 1e-7.
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(pose[:3, 2], arc.tangent([100.0])[0], atol=1e-6)
    np.testing.assert_allclose(pose[:3, 3], arc.at([100.0])[0], atol=1e-4)


def test_tip_that_points_back() -> None:
    pose = tip_pose({"tip_direction": [0.0, 0.0, -1.0], "tip_mm": [1.0, 2.0, 3.0]})
    np.testing.assert_allclose(pose[:3, :3] @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


# OpenIGTLink


def test_igtl_clients_get_pose_points_curve_angles_and_state(igtl: tuple[Hub, IgtlServer]) -> None:
    hub, server = igtl
    clients = [connect(server) for _ in range(3)]
    hub.publish(good(), 1000.25)
    for client in clients:
        got = {}
        for _ in range(5):
            kind, device, body, fields = receive(client)
            got[kind] = (device, body, fields)
        assert list(got) == ["TRANSFORM", "POINT", "POLYDATA", "STRING", "STATUS"]
        message = pyigtl.messages.TransformMessage()
        message.unpack(got["TRANSFORM"][2], got["TRANSFORM"][1])
        assert got["TRANSFORM"][0] == TIP and got["TRANSFORM"][2]["header_version"] == 1
        assert got["TRANSFORM"][2]["timestamp"] == pytest.approx(1000.25, abs=1e-6)
        np.testing.assert_allclose(message.matrix[:3, 3], ARC.at([120.0])[0], atol=1e-3)  # float32 of 100 mm
        points = pyigtl.messages.PointMessage()
        points.unpack(got["POINT"][2], got["POINT"][1])
        np.testing.assert_allclose(points.positions, ARC.at(np.linspace(0, 120, 9)), atol=1e-3)
        text = pyigtl.messages.StringMessage()
        text.unpack(got["STRING"][2], got["STRING"][1])
        assert json.loads(text.string)["length_mm"] == 120.0
        assert got["STATUS"][1][:2] == (1).to_bytes(2, "big")
        client.close()


def test_metadata_for_clients_that_know_them(igtl: tuple[Hub, IgtlServer]) -> None:
    hub, server = igtl
    client = connect(server)
    client.sendall(ask(b"GET_STATUS", struct.pack("> H H I I", 12, 0, 0, 0), version=2))
    assert receive(client)[0] == "STATUS"
    hub.publish(good())
    _, _, body, fields = receive(client)
    message = pyigtl.messages.TransformMessage()
    message.unpack(fields, body)
    assert message.metadata["TransformValid"] == "True" and message.metadata["TransformStatus"] == "OK"
    np.testing.assert_allclose(message.matrix[:3, 3], ARC.at([120.0])[0], atol=1e-3)
    client.close()


def test_a_failure_sends_its_state_alone(igtl: tuple[Hub, IgtlServer]) -> None:
    hub, server = igtl
    client = connect(server)
    hub.publish(FAILED)
    kind, device, body, _ = receive(client)
    code, _, name = struct.unpack_from("> H q 20s", body)
    assert (kind, device, code, name.rstrip(b"\0")) == ("STATUS", STATE, 4, b"tip_not_found")
    assert body.endswith(b"\0") and b"nothing round" in body
    client.close()


def ask(
    kind: bytes, body: bytes = b"", checksum: int | None = None, size: int | None = None, version: int = 1
) -> bytes:
    sum_ = pyigtl.messages.CRC64(body) if checksum is None else checksum
    return HEADER.pack(version, kind, b"", 0, 0, len(body) if size is None else size, sum_) + body


def test_state_is_told_when_asked_for_even_in_pieces(igtl: tuple[Hub, IgtlServer]) -> None:
    _, server = igtl
    client = connect(server)
    for byte in ask(b"GET_STATUS"):
        client.sendall(bytes([byte]))
    assert receive(client)[0] == "STATUS"
    client.sendall(ask(b"GET_STATUS") + ask(b"STRING", b"anything") + ask(b"GET_STATUS"))
    assert receive(client)[0] == receive(client)[0] == "STATUS"
    client.close()


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" + b" " * 40, "not OpenIGTLink"),
        (b"\0" * 200, "not OpenIGTLink"),
        (ask(b"STRING", size=1 << 40), "message too large"),
        (ask(b"STRING", b"abc", checksum=1), "wrong checksum"),
        (ask(b"STRING")[:20], "message not finished"),
        (ask(b"STRING", b"", size=100), "message not finished"),
    ],
)
def test_rude_clients_are_dropped_and_disturb_nobody(igtl: tuple[Hub, IgtlServer], sent: bytes, reason: str) -> None:
    hub, server = igtl
    kind, rude = connect(server), connect(server)
    rude.sendall(sent)
    hub.publish(good())
    assert receive(kind)[0] == "TRANSFORM"
    assert until(lambda: server.dropped.get(reason) == 1, 4.0), server.dropped
    assert until(lambda: len(server.clients) == 1)
    kind.close()
    rude.close()


def test_a_client_that_takes_nothing_is_dropped(igtl: tuple[Hub, IgtlServer]) -> None:
    hub, server = igtl
    stuck = socket.socket()
    stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    stuck.connect(("127.0.0.1", server.port))
    assert until(lambda: len(server.clients) == 1)
    other = connect(server)
    other.settimeout(5)
    drain = threading.Thread(target=lambda: [None for _ in iter(lambda: _quiet(other), b"")], daemon=True)
    drain.start()
    end = time.monotonic() + 10
    while "too slow" not in server.dropped and time.monotonic() < end:
        hub.publish(good())
        time.sleep(0.002)
    assert server.dropped == {"too slow": 1} and len(server.clients) == 1
    stuck.close()
    other.close()


def _quiet(client: socket.socket) -> bytes:
    try:
        return client.recv(1 << 16)
    except OSError:
        return b""


def test_too_many_clients_are_turned_away(igtl: tuple[Hub, IgtlServer]) -> None:
    _, server = igtl
    clients = [connect(server) for _ in range(CLIENTS_MAX)]
    late = socket.create_connection(("127.0.0.1", server.port), timeout=5)
    assert _quiet(late) == b""
    assert until(lambda: server.dropped == {"too many clients": 1})
    for client in (*clients, late):
        client.close()
    assert until(lambda: not server.clients)


@given(st.binary(max_size=200))
def test_no_bytes_break_the_reader(data: bytes) -> None:
    from tubesight.outputs.network.igtl_server import _Client

    class Transport:
        closed = False

        def get_extra_info(self, _: str) -> socket.socket:
            return socket.socket()

        def abort(self) -> None:
            self.closed = True

        def is_closing(self) -> bool:
            return self.closed

        def write(self, _: bytes) -> None: ...

        def get_write_buffer_size(self) -> int:
            return 0

    client = _Client(IgtlServer(port=0))
    client.transport = Transport()  # type: ignore[assignment]
    for size in (1, 7, 58):
        for at in range(0, len(data), size):
            if not client.transport.is_closing():
                client.data_received(data[at : at + size])
    assert len(client._received) <= 58 + (1 << 16)


HEADERS = Path("/usr/include/openigtlink")


@pytest.mark.skipif(not HEADERS.is_dir() or shutil.which("g++") is None, reason="needs g++ and libopenigtlink-dev")
def test_the_official_library_reads_everything(igtl: tuple[Hub, IgtlServer], tmp_path: Path) -> None:
    hub, server = igtl
    program = tmp_path / "client"
    source = Path(__file__).with_name("igtl_client.cpp")
    subprocess.run(
        ["g++", f"-I{HEADERS}", str(source), "-o", str(program), "-lOpenIGTLink", "-lpthread"], check=True, timeout=120
    )
    client = subprocess.Popen([program, "127.0.0.1", str(server.port), "6"], stdout=subprocess.PIPE, text=True)
    assert until(lambda: len(server.clients) == 1)
    hub.publish(good(), 1000.25)
    until(lambda: hub.idle)
    hub.publish(FAILED)
    lines = [json.loads(line) for line in client.communicate(timeout=30)[0].splitlines()]
    assert client.returncode == 0 and all(line["good"] for line in lines)
    kinds = [line["kind"] for line in lines]
    assert kinds == ["TRANSFORM", "POINT", "POLYDATA", "STRING", "STATUS", "STATUS"]
    transform, points, curve, text, state, failed = lines
    tip = ARC.at([120.0])[0]
    assert transform["device"] == TIP and transform["time_s"] == pytest.approx(1000.25, abs=1e-5)
    for found in (transform["tip_mm"], points["last_mm"], curve["last_mm"]):
        np.testing.assert_allclose(found, tip, atol=1e-3)  # float32 of 100 mm, rounded to 1e-4
    np.testing.assert_allclose(transform["z"], ARC.tangent([120.0])[0], atol=1e-6)
    assert (points["count"], curve["count"], curve["line"]) == (9, 33, 33)
    assert text["text"]["length_mm"] == 120.0
    assert (state["code"], failed["code"], failed["name"]) == (1, 4, "tip_not_found")


# WebSocket, UDP


def test_clients_iterate_await_and_are_called(web: tuple[Hub, WebSocketServer]) -> None:
    hub, server = web
    called: list[Result] = []
    stream = results(server.address)
    hub.publish(good("a"), 5.0)
    first = next(stream)
    assert first.message.frame == "a" and first.message.time_s == 5.0
    thread = subscribe(server.address, called.append)
    assert until(lambda: len(called) == 1), "the last result comes first"

    async def await_two() -> list[str]:
        return [r.message.frame async for r, _ in _zip(results_async(server.address), 2)]

    async def _zip(source: Any, count: int) -> Any:
        async for item in source:
            yield item, count
            if item.message.frame == "b":
                return

    threading.Timer(0.3, lambda: hub.publish(good("b"))).start()
    assert asyncio.run(await_two()) == ["a", "b"]
    assert next(stream).message.frame == "b"
    stream.close()
    assert until(lambda: len(called) == 2) and thread.is_alive()


@pytest.mark.parametrize(
    ("headers", "why"),
    [
        ({"Origin": "https://evil.example"}, "other sites"),
        ({"Origin": "null"}, "other sites"),
        ({"Host": "evil.example"}, "not this server's"),
        ({"Host": "127.0.0.1.evil.example"}, "not this server's"),
    ],
)
def test_other_sites_are_refused(web: tuple[Hub, WebSocketServer], headers: dict[str, str], why: str) -> None:
    _, server = web
    assert why in _upgrade(server.port, headers)


def test_own_pages_may_connect(web: tuple[Hub, WebSocketServer]) -> None:
    _, server = web
    assert _upgrade(server.port, {"Origin": f"http://localhost:{server.port}"}).startswith("HTTP/1.1 101")


def _upgrade(port: int, headers: dict[str, str], target: str = "/") -> str:
    headers = {
        "Host": f"127.0.0.1:{port}",
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
        "Sec-WebSocket-Version": "13",
    } | headers
    with socket.create_connection(("127.0.0.1", port), timeout=5) as client:
        lines = "".join(f"{k}: {v}\r\n" for k, v in headers.items())
        client.sendall(f"GET {target} HTTP/1.1\r\n{lines}\r\n".encode())
        data = b""
        while b"\r\n\r\n" not in data or data.startswith(b"HTTP/1.1 4"):
            more = client.recv(4096)
            if not more:
                break
            data += more
    return data.decode()


def test_schema_is_served(web: tuple[Hub, WebSocketServer]) -> None:
    import urllib.request

    _, server = web
    with urllib.request.urlopen(f"http://127.0.0.1:{server.port}/schema.json", timeout=5) as answer:
        assert json.load(answer) == message_schema()


def test_a_token_is_needed_where_others_can_reach_the_port() -> None:
    access = Access.to("0.0.0.0")
    assert len(access.token) >= 20 and "0.0.0.0" in access.warning
    server = WebSocketServer(access, port=0)
    with Hub([server]) as hub:
        hub.publish(good())
        assert next(results(f"ws://127.0.0.1:{server.port}/?token={access.token}"))
        for wrong in ("", "?token=", "?token=guess"):
            with pytest.raises(InputError, match="token"):
                next(results(f"ws://127.0.0.1:{server.port}/{wrong}"))


@pytest.mark.parametrize("address", ["ws://127.0.0.1:1", "http://x", "nonsense"])
def test_nothing_there_is_said(address: str) -> None:
    with pytest.raises(InputError, match=r"is the sensor running|not an address"):
        next(results(address))


def test_datagrams_carry_messages() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.settimeout(5)
        with Hub([UdpSender(port=listener.getsockname()[1])]) as hub:
            hub.publish(good("d"))
            assert Result.of(listener.recv(65536)).message.frame == "d"


def test_nobody_listening_to_datagrams_is_no_error() -> None:
    with Hub([UdpSender(port=1)]) as hub:
        for _ in range(5):
            hub.publish(good())
            time.sleep(0.01)


def test_a_port_in_use_is_named() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=f"{port}.*choose another port"), Hub([IgtlServer(port=port)]):
            pass


def test_faster_results_replace_each_other() -> None:
    """Nothing piles up while the loop is busy, and the newest is sent."""

    class Slow:
        address = "slow"

        def __init__(self) -> None:
            self.got: list[int] = []

        async def start(self) -> None: ...

        def send(self, message: dict[str, Any]) -> None:
            time.sleep(0.05)
            self.got.append(message["number"])

        async def stop(self) -> None: ...

    slow = Slow()
    with Hub([slow]) as hub:
        for _ in range(200):
            hub.publish(good())
        assert until(lambda: 199 in slow.got)
    assert hub.replaced + len(slow.got) == 200 and slow.got == sorted(slow.got)


@pytest.mark.parametrize(
    ("host", "own"), [("127.0.0.1", True), ("localhost", True), ("::1", True), ("127.8.9.1", True), ("0.0.0.0", False),
                      ("192.168.0.4", False), ("localhost.evil.example", False), ("", False)]
)  # fmt: skip
def test_loopback_is_told_from_the_rest(host: str, own: bool) -> None:
    assert is_loopback(host) is own


def test_everything_listens_on_loopback_alone() -> None:
    import psutil

    servers = [IgtlServer(port=0), WebSocketServer(Access(), port=0), UdpSender()]
    with Hub(servers):
        listening = [c for c in psutil.Process().net_connections() if c.status == psutil.CONN_LISTEN]
        assert {s.port for s in servers[:2]} <= {c.laddr.port for c in listening}
        assert all(is_loopback(c.laddr.ip) for c in listening)


def test_packing_survives_any_text() -> None:
    odd = replace(good(), notes=("\N{SNOWMAN}" * 500,))
    assert pack_result(result_message(odd, 2**40), 0.0)
