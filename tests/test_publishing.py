"""Live results to network outputs and viewer: options, warnings, faults, and what reaches a client."""

from __future__ import annotations

import socket
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tubesight.client import results
from tubesight.core import InputError, Status
from tubesight.geometry.curve import Arc
from tubesight.geometry.shape import shape_of
from tubesight.sensor import Reconstruction
from tubesight.tracking.states import State
from tubesight.tracking.tracker import Tracked

pytest.importorskip("pyigtl")
pytest.importorskip("websockets")

from tubesight.apps.live.publishing import (
    NetworkSubscriber,
    Place,
    PublishOptions,
    open_subscribers,
    result_of,
)

ARC = Arc(np.array([0.003, 0.001]), 100.0)
STEERING: Any = SimpleNamespace()


def tracked(name: str = "0") -> Tracked:
    result = Reconstruction(name, Status.OK, (), shape_of(ARC, 0.1), ARC, {}, "silhouette", 0.05, {"solve": 0.3})
    return Tracked(result, State.TRACKING, time.monotonic())


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [("8765", "127.0.0.1", 8765), ("0.0.0.0:1", "0.0.0.0", 1), ("[::1]:9", "::1", 9), ("lab:0", "lab", 0)],
)
def test_places(text: str, host: str, port: int) -> None:
    assert Place.of(text) == Place(host, port)


@pytest.mark.parametrize("text", ["", "x", "127.0.0.1", "1:70000", "1:-1", "1:²"])
def test_what_is_no_place_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="expected a port"):
        Place.of(text)


def test_a_result_reaches_a_client_with_the_time_of_its_pictures() -> None:
    (subscriber,), messages = open_subscribers(PublishOptions(websocket=Place("127.0.0.1", 0)), STEERING)
    try:
        assert messages == [m for m in messages if m.startswith("results: ws://127.0.0.1:")]
        subscriber.publish(tracked("first"))
        result = next(results(messages[-1].partition(" ")[2]))
        assert result.message.frame == "first"
        assert result.message.time_s == pytest.approx(time.time(), abs=10.0)  # the wall clock, not the monotonic one
    finally:
        subscriber.close()


def test_other_addresses_warn_and_make_a_token() -> None:
    options = PublishOptions(Place("0.0.0.0", 0), Place("0.0.0.0", 0), Place("192.0.2.1", 9))
    subscriber = NetworkSubscriber(options)
    subscriber.close()
    warnings = [m for m in subscriber.messages if m.startswith("warning")]
    assert len(warnings) == 3 and any("token=" in m for m in subscriber.messages)


def test_a_port_in_use_leaves_nothing_open() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = other.getsockname()[1]
        with pytest.raises(InputError, match="choose another port"):
            open_subscribers(PublishOptions(igtl=Place("127.0.0.1", 0), websocket=Place("127.0.0.1", taken)), STEERING)


def test_a_fault_has_no_numbers() -> None:
    fault = Tracked(None, State.FAULT, time.monotonic(), notes=("left: no picture for 120 ms",))
    result = result_of(fault)
    assert not result and result.notes == fault.notes and result.shape is None
