"""A page in headless Chromium, driven by its developer tools."""

from __future__ import annotations

import base64
import contextlib
import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_FLAGS = (
    "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0", "--no-first-run", "--disable-background-networking", "--window-size=1600,1000",
)  # fmt: skip


def chromium() -> str:
    """Path of the browser; skips the test where there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        found = shutil.which(name)
        if found:
            return found
    pytest.skip("needs Chromium")


class Page:
    """One page; keeps what it writes to the console and which addresses it asks for."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._calls = 0
        self.problems: list[str] = []
        self.addresses: set[str] = set()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the developer tools."""
        self._calls += 1
        self._socket.send(json.dumps({"id": self._calls, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == self._calls:
                assert "error" not in answer, answer
                return dict(answer["result"])
            self._keep(answer)

    def wait(self, seconds: float) -> None:
        """Let the page work."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            with contextlib.suppress(TimeoutError):
                self._keep(json.loads(self._socket.recv(timeout=0.2)))

    def until(self, expression: str, seconds: float = 60.0) -> bool:
        """Wait for an expression in the page to be true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self.call("Runtime.evaluate", expression=f"Boolean({expression})")["result"].get("value"):
                return True
            self.wait(0.3)
        return False

    def click(self, x: float, y: float) -> None:
        """Click at a place of the window."""
        self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def screenshot(self, path: Path) -> None:
        """Write what is seen to a PNG."""
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))

    def _keep(self, event: dict[str, Any]) -> None:
        method, p = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(p["exceptionDetails"])[:500])
        elif (method == "Log.entryAdded" and p["entry"]["level"] == "error") or (
            method == "Runtime.consoleAPICalled" and p["type"] == "error"
        ):
            self.problems.append(json.dumps(p)[:500])
        elif method == "Network.requestWillBeSent":
            self.addresses.add(p["request"]["url"])


@contextmanager
def open_page(address: str, profile: Path) -> Iterator[Page]:
    """Open an address in a browser of its own."""
    from websockets.sync.client import connect

    program = subprocess.Popen(
        [chromium(), *_FLAGS, f"--user-data-dir={profile}", "about:blank"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        port_file = profile / "DevToolsActivePort"
        for _ in range(300):
            if port_file.exists() and port_file.read_text():
                break
            time.sleep(0.1)
        port = int(port_file.read_text().splitlines()[0])
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10) as answer:
            target = next(t for t in json.load(answer) if t["type"] == "page")
        with connect(target["webSocketDebuggerUrl"], max_size=None, open_timeout=20) as socket:
            page = Page(socket)
            for domain in ("Runtime", "Log", "Page", "Network"):
                page.call(f"{domain}.enable")
            page.call("Page.navigate", url=address)
            yield page
    finally:
        program.kill()
        program.wait(10)
