"""``tubesight soak --everything``: network cameras, recording, every output with a client, an open page, at once."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tubesight.apps.live.loop import Moment
from tubesight.apps.live.mjpeg import read_number
from tubesight.apps.live.options import LiveOptions, RecordOptions, set_up
from tubesight.apps.live.peers import browser, network_cameras, network_clients
from tubesight.apps.live.publishing import NetworkSubscriber, Place, PublishOptions
from tubesight.apps.live.session import run_session
from tubesight.apps.live.soak import Growth, growth
from tubesight.apps.live.stats import Figures, Latencies
from tubesight.apps.live.steering import steering_of
from tubesight.files.packages import require_package
from tubesight.files.rig import save_rig
from tubesight.files.safe import write_atomic
from tubesight.files.tube import tube_text
from tubesight.outputs.machine import resident_mb
from tubesight.outputs.network.access import LOOPBACK
from tubesight.sources.simulated import SIM_SIZE, SIM_TUBE, sim_rig

if TYPE_CHECKING:
    from tubesight.apps.live.watching import ViewerSubscriber

# A browser without a graphics card needs so long to open the page on a busy machine.
_PAGE_S = 60.0


@dataclass(frozen=True, slots=True)
class Everything:
    """What a session with everything at once came to.

    Attributes
    ----------
    figures
        Of the session: rate, latency from the instant of the pictures, refused pictures, what was recorded.
    decoded_median_ms, decoded_p99_ms
        From the later of a pair's pictures being decoded to its result having been handed to every output.
    pairs, mixed
        Pairs measured, and those of them whose pictures are of two instants, by the numbers written into the pictures.
    memory
        How the resident memory grows after the warm-up.
    cpu_ms_per_pair
        Time of all threads of the measuring process, the recorder, outputs and page server included.
    clients
        Messages received, by client and kind.
    pages
        Browser windows that showed the page at the end; None where no browser was found.
    recording
        Where the recording is; empty where it was made in a temporary folder and is gone.
    """

    figures: Figures
    decoded_median_ms: float
    decoded_p99_ms: float
    pairs: int
    mixed: int
    memory: Growth
    cpu_ms_per_pair: float
    clients: Mapping[str, Mapping[str, int]]
    pages: int | None
    recording: str

    @property
    def good(self) -> bool:
        """Whether nothing was mixed up, everything received results, and the recording went on to the end."""
        whole = bool(self.figures.recorded.get("results")) and "stopped" not in self.figures.recorded
        served = all(self.clients.values()) and self.pages != 0
        return self.mixed == 0 and self.figures.ok > 0 and whole and served

    def as_dict(self) -> dict[str, Any]:
        """Plain data for ``--json``."""
        return asdict(self)


class _Watch:
    """Looks at each moment on the measuring thread."""

    def __init__(self, seconds: float, page: ViewerSubscriber) -> None:
        self._every_s, self._page = seconds / 200, page
        self.memory: list[tuple[float, float]] = []
        self.decoded = Latencies()
        self.mixed = self.pages = 0

    def __call__(self, moment: Moment) -> None:
        now = time.monotonic()
        if not self.memory or now - self.memory[-1][0] > self._every_s:
            self.memory.append((now, resident_mb()))
            self.pages = self._page.windows
        pair = moment.tracked.pair
        if pair is not None and moment.tracked.result is not None:
            frames = pair.frames.values()
            self.decoded.add(1e3 * (now - max(frame.decoded_s for frame in frames)))
            self.mixed += len({read_number(frame.image) for frame in frames}) > 1


def everything(
    seconds: float,
    hz: float,
    size_px: tuple[int, int] = SIM_SIZE,
    record: RecordOptions | None = None,
    tell: Callable[[str], None] = lambda line: None,
) -> Everything:
    """Run everything at once on this machine.

    Parameters
    ----------
    seconds, hz, size_px
        Length of the session; pictures a second and their size.
    record
        Where to record; None for a temporary folder, with all pictures.
    tell
        Called with what the user should know.

    Raises
    ------
    InputError
        If a package is missing, a port or file cannot be opened, or something does not start.
    """
    require_package("viser", "view", "the viewer needs the package viser")
    from tubesight.apps.live.watching import ViewerSubscriber

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tubesight-soak-")))
        cameras = stack.enter_context(network_cameras(size_px, hz))
        clients = stack.enter_context(network_clients())
        options = _options(cameras, folder, size_px, seconds, record)
        setup = set_up(options)
        steering = steering_of(options, setup)
        opened = stack.enter_context(ExitStack())
        place = Place(LOOPBACK, 0)
        network = NetworkSubscriber(PublishOptions(place, place, Place(LOOPBACK, clients.udp_port)))
        opened.callback(network.close)
        page = ViewerSubscriber(steering, 0)
        opened.callback(page.close)
        clients.connect(*(int(address.strip("/").rpartition(":")[2]) for address in network.addresses[:2]))
        there = stack.enter_context(browser(page.address, folder / "browser"))
        _await_page(page, there, tell)
        watch = _Watch(seconds, page)
        # From here on the session closes them.
        opened.pop_all()
        before = time.process_time()
        figures = run_session(options, setup, watch, (network, page), steering=steering)
        cpu_s = time.process_time() - before
        received = clients.received()
    return Everything(
        figures,
        *watch.decoded.median_and_p99_ms(),
        figures.pairs,
        watch.mixed,
        growth(watch.memory),
        1e3 * cpu_s / figures.pairs if figures.pairs else math.nan,
        received,
        watch.pages if there else None,
        str(record.path) if record is not None else "",
    )


def _options(
    cameras: str, folder: Path, size_px: tuple[int, int], seconds: float, record: RecordOptions | None
) -> LiveOptions:
    """Write rig and tube of the simulated cameras, and say what is to be run."""
    rig, tube = folder / "rig.yaml", folder / "tube.yaml"
    save_rig(rig, sim_rig(size_px, ("left", "right")))
    write_atomic(tube, tube_text(SIM_TUBE))
    sources = {name: f"{cameras}/{name}" for name in ("left", "right")}
    record = record or RecordOptions(folder / "soak.mcap")
    return LiveOptions(sources, rig, tube, size_px=size_px, seconds=seconds, record=record)


def _await_page(page: ViewerSubscriber, there: bool, tell: Callable[[str], None]) -> None:
    """Wait until the browser shows the page, and say where there is none."""
    if not there:
        tell("no Chromium on the path: nobody looks at the page")
        return
    end = time.monotonic() + _PAGE_S
    while page.windows == 0 and time.monotonic() < end:
        time.sleep(0.1)
    if page.windows == 0:
        tell(f"the browser did not show the page within {_PAGE_S:g} s")
