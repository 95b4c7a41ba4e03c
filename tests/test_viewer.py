"""The viewer: geometry of what it draws, who may connect, and the page in a browser without network."""

from __future__ import annotations

import math
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conftest import MOCKUP_TUBE, SimulatedPair
from tubesight.core import InputError, Status
from tubesight.geometry.curve import Arc
from tubesight.geometry.rig import Rig
from tubesight.geometry.shape import shape_of
from tubesight.sensor import Reconstruction
from tubesight.simulate import rig_around
from tubesight.simulate.phantom import Arc as Bend

pytest.importorskip("viser")

from browser import open_page
from http_cameras import serve
from tubesight.apps.viewer.cameras import clicked_px, plane_corners
from tubesight.apps.viewer.controls import Controls
from tubesight.apps.viewer.panel import _numbers, badge
from tubesight.apps.viewer.scene import ALONG, AROUND, MM, tube_mesh
from tubesight.apps.viewer.viewer import Viewer

RIG = rig_around(90.0, size_px=(1280, 720))


def measured(degrees: float, name: str = "0001") -> Reconstruction:
    arc = Arc(np.array([math.radians(degrees) / 120, 0.0]), 120.0)
    return Reconstruction(name, Status.OK, (), shape_of(arc, 0.1), arc, {}, "silhouette", 0.05, {"solve": 0.3})


@given(st.floats(0, 160), st.floats(0, 360), st.floats(0.5, 8))
def test_tube_mesh_keeps_its_distance_and_faces_out(theta: float, phi: float, radius: float) -> None:
    bend = math.radians(theta) / 100 * np.array([math.cos(math.radians(phi)), math.sin(math.radians(phi))])
    arc = Arc(bend, 100.0)
    vertices, faces = tube_mesh(arc, radius)
    centres = arc.at(np.linspace(0, 100, ALONG))
    rings = vertices[:-2].reshape(ALONG, AROUND, 3)
    # Rings are made of unit vectors: rounding alone.
    np.testing.assert_allclose(np.linalg.norm(rings - centres[:, None], axis=2), radius, rtol=1e-9)
    assert faces.min() == 0 and faces.max() == len(vertices) - 1
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    # The volume by the divergence theorem is positive when all faces look outwards, and near that of the tube: a ring
    # of 16 corners has 0.974 of a circle's area.
    volume = float((a * normals).sum() / 6)
    assert volume == pytest.approx(0.974 * math.pi * radius**2 * 100, rel=0.03)


@given(st.floats(1, 1279), st.floats(1, 719), st.floats(5, 400), st.tuples(*[st.floats(-2, 2)] * 3))
def test_a_click_on_a_picture_is_its_pixel(u: float, v: float, depth: float, off: tuple[float, float, float]) -> None:
    name = RIG.names[0]
    camera, base_from_camera = RIG.cameras[name], RIG.camera_from_base[name].inverse()
    corners = plane_corners(camera) * depth
    share = (np.array([u, v]) + 0.5) / camera.size_px
    point = corners[0] + share[0] * (corners[1] - corners[0]) + share[1] * (corners[3] - corners[0])
    target = base_from_camera.apply(point)
    eye = base_from_camera.apply(np.array([0, 0, -depth])) + np.array(off)
    found = clicked_px(camera, base_from_camera, depth, eye, target - eye)
    assert found is not None
    np.testing.assert_allclose(found, [u, v], atol=1e-6)
    assert clicked_px(camera, base_from_camera, depth, eye, eye - target + 1e9) is None


def test_names_cannot_become_markup() -> None:
    nasty = "<script>alert(1)</script>"
    assert "<script>" not in badge(nasty, nasty, False)
    assert "<script>" not in _numbers(measured(30, nasty), nasty)


def _status_line(port: int, **headers: str) -> str:
    head = {"Host": f"127.0.0.1:{port}"} | {k.replace("_", "-"): v for k, v in headers.items()}
    with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
        client.sendall(("GET / HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in head.items()) + "\r\n").encode())
        return client.recv(4096).decode("latin-1").splitlines()[0]


def test_only_own_pages_may_connect() -> None:
    with Viewer(RIG, MOCKUP_TUBE, 0) as viewer:
        port = viewer.server.get_port()
        assert viewer.address.startswith("http://127.0.0.1:")
        assert " 200 " in _status_line(port)
        assert " 403 " in _status_line(port, Host="evil.example")
        upgrade = {
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec_WebSocket_Key": "AAAAAAAAAAAAAAAAAAAAAA==",
            "Sec_WebSocket_Version": "13",
        }
        assert " 403 " in _status_line(port, Origin="https://evil.example", **upgrade)
        assert " 101 " in _status_line(port, Origin=viewer.address, **upgrade)


def test_no_page_can_publish_the_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """viser offers a public relay; here nothing leaves the machine even if a page asks."""
    with Viewer(RIG, MOCKUP_TUBE, 0) as viewer:
        monkeypatch.setattr(socket, "create_connection", lambda *_, **__: pytest.fail("connects outwards"))
        assert viewer.server.request_share_url() is None


def test_a_port_in_use_is_named() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        with pytest.raises(InputError, match="choose another port"):
            Viewer(RIG, MOCKUP_TUBE, other.getsockname()[1])


def test_publishing_never_waits() -> None:
    """A thousand results come faster than any browser: handing them over takes no drawing."""
    with Viewer(RIG, MOCKUP_TUBE, 0) as viewer:
        shown: list[float] = []
        show = viewer._panel.show
        viewer._panel.show = lambda r, t, s: (shown.append(t), show(r, t, s))[1]  # type: ignore[method-assign]
        for k in range(1000):
            viewer.publish(measured(k % 90), None, float(k))
        end = time.monotonic() + 10
        while 999.0 not in shown and time.monotonic() < end:
            time.sleep(0.02)
        assert shown[-1] == 999.0 and len(shown) < 500


def test_page_shows_the_shape_without_network(simulated_pair: Callable[..., SimulatedPair], tmp_path: Path) -> None:
    """In headless Chromium: no error on the console, no address but our own, and a click on a picture is a pixel."""
    seen = simulated_pair(Bend(math.radians(40), 0.5, 120.0))
    marked: list[tuple[str, str, Any]] = []
    done = threading.Event()

    def mark(what: str, camera: str, px: Any) -> None:
        marked.append((what, camera, px))
        done.set()

    controls = Controls(("silhouette",), lambda _: None, ("base", "tip"), mark)
    nasty = "<img src=x onerror='window.broken = 1'>"
    with Viewer(seen.rig, seen.tube, 0, controls) as viewer:
        look_along(viewer, seen.rig)
        result = replace(measured(40, "<script>window.broken = 1</script>"), notes=(nasty,))
        viewer.publish(result, seen.pair, 0.0, f"30 a second {nasty}")
        with open_page(viewer.address, tmp_path) as page:
            assert page.until("document.body.innerText.includes('tip x')"), "the panel is there"
            assert page.until("document.querySelector('canvas') && document.querySelector('img')"), "both drawn"
            page.wait(2.0)
            viewer.controls._mark = "tip"
            page.screenshot(tmp_path / "page.png")
            page.click(*middle_of_canvas(page))
            done.wait(20)
            assert not page.call("Runtime.evaluate", expression="Boolean(window.broken)")["result"]["value"]
        # viser's page takes back a picture's blob when the next one comes, at times before the browser has drawn it.
        assert [p for p in page.problems if "blob:" not in p] == []
        own = (viewer.address, viewer.address.replace("http", "ws"), "data:", "blob:", "about:")
        assert all(address.startswith(own) for address in page.addresses), page.addresses
    assert marked and marked[0][:2] == ("tip", seen.rig.names[0])
    # The canvas' middle looks along the camera's axis: at its principal point, to a pixel of a window half as wide.
    camera = seen.rig.cameras[seen.rig.names[0]]
    np.testing.assert_allclose(marked[0][2], camera.matrix[:2, 2], atol=4.0)


def test_a_device_with_a_nasty_name_is_harmless(simulated_pair: Callable[..., SimulatedPair], tmp_path: Path) -> None:
    """No file can name a camera so; a program that makes its own rig can."""
    seen = simulated_pair(Bend(math.radians(40), 0.5, 120.0))
    nasty = ("<script>window.broken=1<script>", "<img src=x onerror=window.broken=1>")
    names = dict(zip(seen.rig.names, nasty, strict=True))
    rig = Rig(
        {names[k]: camera for k, camera in seen.rig.cameras.items()},
        {names[k]: pose for k, pose in seen.rig.camera_from_base.items()},
    )
    pair = replace(seen.pair, images={names[k]: image for k, image in seen.pair.images.items()})
    with Viewer(rig, seen.tube, 0) as viewer:
        viewer.publish(measured(40), pair, 0.0)
        with open_page(viewer.address, tmp_path) as page:
            assert page.until("document.body.innerText.includes('tip x') && document.querySelector('img')")
            page.wait(2.0)
            assert not page.call("Runtime.evaluate", expression="Boolean(window.broken)")["result"]["value"]


def test_a_page_of_another_site_cannot_connect(tmp_path: Path) -> None:
    """In Chromium: the viewer's own page is connected, one from another port of this machine is refused."""
    script = """<script>window.said = ''
        const socket = new WebSocket('ADDRESS'.replace('http', 'ws'), 'viser-v1.1.1')
        socket.onopen = () => { window.said = 'open' }
        socket.onerror = () => { window.said = 'refused' }
        fetch('ADDRESS').then(r => r.text()).then(t => { window.read = t }, () => { window.read = 'refused' })
        </script>other site"""

    def respond(handler: Any) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "text/html")
        handler.end_headers()
        handler.wfile.write(script.replace("ADDRESS", viewer.address).encode())

    with Viewer(RIG, MOCKUP_TUBE, 0) as viewer, serve(respond) as other, open_page(other, tmp_path) as page:
        assert page.until("window.said && window.read")
        value = page.call("Runtime.evaluate", expression="window.said + ' ' + window.read")["result"]["value"]
        assert value == "refused refused" and not viewer.server.get_clients()
        page.call("Page.navigate", url=viewer.address)
        assert page.until("document.body.innerText.includes('pipeline') || document.body.innerText.includes('waiting')")
        assert len(viewer.server.get_clients()) == 1


def test_connections_that_are_not_used_are_no_news(capfd: pytest.CaptureFixture[str]) -> None:
    with Viewer(RIG, MOCKUP_TUBE, 0) as viewer:
        for sent in (b"", b"\0\xff" * 200, b"GET / HTTP/1.1\r\n"):
            with socket.create_connection(("127.0.0.1", viewer.server.get_port())) as client:
                client.sendall(sent)
        time.sleep(0.3)
    assert capfd.readouterr() == ("", "")


def look_along(viewer: Viewer, rig: Rig) -> None:
    """Look through the first camera."""
    pose = rig.camera_from_base[rig.names[0]].inverse()
    viewer.server.initial_camera.position = tuple(pose.translation_mm * MM)
    viewer.server.initial_camera.look_at = tuple((pose.translation_mm + 300 * pose.rotation[:, 2]) * MM)


def middle_of_canvas(page: Any) -> tuple[float, float]:
    script = "(() => { const b = document.querySelector('canvas').getBoundingClientRect(); \
        return [b.x + b.width / 2, b.y + b.height / 2]; })()"
    x, y = page.call("Runtime.evaluate", expression=script, returnByValue=True)["result"]["value"]
    return float(x), float(y)


def test_view_command_goes_through_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from small_set import write_small_set
    from tubesight.cli.main import main

    folder = write_small_set(tmp_path)
    args = [str(folder / "photos"), "--rig", str(folder / "rig.yaml"), "--tube", str(folder / "tube.yaml")]
    with pytest.raises(SystemExit) as left:
        main(["view", *args, "--port", "0", "--pairs", "2"])
    assert not left.value.code
    assert "open http://127.0.0.1:" in capsys.readouterr().err
    with pytest.raises(SystemExit) as left:
        main(["view", *args, "--port", "70000"])
    assert left.value.code == 1
    assert "70000 is no port" in capsys.readouterr().err
