"""A session with everything at once: on loopback alone, and without any network."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import psutil
import pytest

pytest.importorskip("viser")
pytest.importorskip("pyigtl")
pytest.importorskip("websockets")

from live_scenes import SIZE, picture
from tubesight.apps.live.everything import everything
from tubesight.apps.live.mjpeg import SWING, read_number, write_number
from tubesight.apps.live.options import RecordOptions
from tubesight.apps.live.replay import replay_file
from tubesight.outputs.network.access import is_loopback

SECONDS, HZ = 2.0, 15.0
# Brings up the loopback of a new network namespace (flag IFF_UP by SIOCSIFFLAGS) as `ip link set lo up` does, which not
# every machine has; then shows that there is no route, and goes on as the command.
ALONE = """
import fcntl, os, socket, struct, sys
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
    fcntl.ioctl(control, 0x8914, struct.pack("16sH14x", b"lo", 1))
with open("/proc/net/route") as routes:
    assert len(routes.read().splitlines()) <= 1, "there is a route"
os.execv(sys.executable, [sys.executable, "-m", "tubesight", *sys.argv[1:]])
"""


def test_numbers_in_pictures_are_read_again() -> None:
    import cv2

    image = picture("left", 0)
    for number in range(SWING):
        coded = cv2.imencode(".jpg", write_number(image, number), [cv2.IMWRITE_JPEG_QUALITY, 60])[1]
        assert read_number(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)) == number
    assert read_number(np.dstack([write_number(image, 19)] * 3)) == 19


def test_everything_at_once_talks_to_this_machine_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All sockets of the process and of what it starts, while it runs: listening and connected ones."""
    monkeypatch.setenv("PATH", str(tmp_path))
    ended, seen, said = threading.Event(), set(), []
    own = psutil.Process()

    def look() -> None:
        while not ended.wait(0.05):
            for process in (own, *own.children(recursive=True)):
                try:
                    found = process.net_connections("inet")
                except psutil.NoSuchProcess:
                    continue
                for end in (end for c in found for end in (c.laddr, c.raddr) if end):
                    seen.add((end.ip, end.port))

    thread = threading.Thread(target=look)
    thread.start()
    try:
        path = tmp_path / "everything.mcap"
        done = everything(SECONDS, HZ, SIZE, RecordOptions(path), said.append)
    finally:
        ended.set()
        thread.join()
    # Cameras (3), two servers with a client each (4), datagrams (2), the page (1).
    assert len(seen) >= 10 and all(is_loopback(ip) for ip, _ in seen), seen
    assert done.good and done.mixed == 0 and done.pages is None and "no Chromium" in said[0]
    assert (
        done.pairs == done.figures.pairs > SECONDS * HZ / 2
        and 0 < done.decoded_median_ms < done.figures.latency_ms + 100
    )
    assert done.clients["WebSocket"]["results"] > 0 and done.clients["UDP"]["results"] > 0
    assert done.clients["OpenIGTLink"]["TRANSFORM"] > 0
    replayed = replay_file(path)
    assert replayed.equal == replayed.compared == done.pairs


def alone() -> list[str]:
    """Words that run a command without any network; skips the test where the machine forbids it."""
    program = shutil.which("unshare")
    if program is None:
        pytest.skip("needs unshare")
    for words in ([program, "-n"], [program, "-rn"]):
        if subprocess.run([*words, "true"], capture_output=True).returncode == 0:
            return words
    pytest.skip("this machine forbids network namespaces")


def test_everything_works_without_any_network() -> None:
    """With a page in Chromium, where there is one."""
    size = f"{SIZE[0]}x{SIZE[1]}"
    given = ["soak", "--everything", "--seconds", str(SECONDS), "--hz", str(HZ), "--size", size, "--json"]
    run = subprocess.run(
        [*alone(), sys.executable, "-c", ALONE, *given],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONWARNINGS": "default"},
    )
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr
    done = json.loads(run.stdout)
    assert done["mixed"] == 0 and done["figures"]["ok"] > 0 and done["figures"]["recorded"]["results"] > 0
    assert set(done["clients"]) == {"OpenIGTLink", "WebSocket", "UDP"} and all(done["clients"].values())
    assert done["pages"] == 1 or done["pages"] is None
