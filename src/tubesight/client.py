"""Receiving results from a running sensor: an iterator, an asynchronous iterator or a callback, with NumPy arrays.

Examples
--------
>>> from tubesight.client import results
>>> for result in results("ws://127.0.0.1:8765"):  # doctest: +SKIP
...     print(result.tip_mm, result.sd_tip_mm)
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass

import numpy as np

from tubesight.core import Array, InputError, readonly
from tubesight.files.message import MESSAGE_BYTES, ResultMessage, parse_message

# Longest time to connect.
_CONNECT_S = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """One result; truthy where its status is ``ok``. What is not known is NaN.

    Attributes
    ----------
    message
        The message as it came.
    tip_mm, sd_tip_mm
        (3,) tip in the base frame, and its standard deviations.
    bending_rad, orientation_rad, length_mm
        As in `tubesight.geometry.shape.Shape`.
    curve_mm, sd_curve_mm
        (K, 3) and (K,); no points where there is no curve.
    """

    message: ResultMessage
    tip_mm: Array
    sd_tip_mm: Array
    bending_rad: float
    orientation_rad: float
    length_mm: float
    curve_mm: Array
    sd_curve_mm: Array

    def __post_init__(self) -> None:
        for name in ("tip_mm", "sd_tip_mm"):
            object.__setattr__(self, name, readonly(getattr(self, name), (3,), name))
        object.__setattr__(self, "curve_mm", readonly(self.curve_mm, (None, 3), "curve_mm"))
        object.__setattr__(self, "sd_curve_mm", readonly(self.sd_curve_mm, (None,), "sd_curve_mm"))

    def __bool__(self) -> bool:
        return self.message.status == "ok"

    @classmethod
    def of(cls, text: str | bytes) -> Result:
        """Read a message; raise `InputError` where it is none."""
        m = parse_message(text)
        nan = float("nan")
        return cls(
            m,
            _numbers(m.tip_mm or (nan, nan, nan)),
            _numbers(m.sd.tip_mm if m.sd else (nan, nan, nan)),
            float(np.radians(_number(m.bending_deg))),
            float(np.radians(_number(m.orientation_deg))),
            _number(m.length_mm),
            np.array(m.curve_mm or np.empty((0, 3))),
            _numbers(m.curve_sd_mm or ()),
        )


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _numbers(values: object) -> Array:
    return np.array(values, dtype=np.float64)


def results(address: str) -> Iterator[Result]:
    """Yield results as they come, until the sender ends.

    Parameters
    ----------
    address
        ``ws://host:port``, with ``/?token=...`` where the sender asks for one.

    Raises
    ------
    InputError
        If nothing answers there, or what comes is no result.
    """
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    with _explained(address):
        connection = connect(address, open_timeout=_CONNECT_S, max_size=MESSAGE_BYTES, compression=None)
    with connection, contextlib.suppress(ConnectionClosed):
        while True:
            yield Result.of(connection.recv())


async def results_async(address: str) -> AsyncIterator[Result]:
    """Yield results as they come; see `results`."""
    from websockets.asyncio.client import connect
    from websockets.exceptions import ConnectionClosed

    with _explained(address):
        connection = await connect(address, open_timeout=_CONNECT_S, max_size=MESSAGE_BYTES, compression=None)
    async with connection:
        with contextlib.suppress(ConnectionClosed):
            while True:
                yield Result.of(await connection.recv())


def subscribe(address: str, callback: Callable[[Result], object]) -> threading.Thread:
    """Call a function for each result, in a thread that ends with the sender; see `results`."""

    def run() -> None:
        for result in results(address):
            callback(result)

    thread = threading.Thread(target=run, name="tubesight results", daemon=True)
    thread.start()
    return thread


@contextlib.contextmanager
def _explained(address: str) -> Iterator[None]:
    from websockets.exceptions import InvalidHandshake, InvalidStatus, InvalidURI

    try:
        yield
    except InvalidURI as error:
        raise InputError(f"{address[:80]}: not an address; expected for example ws://127.0.0.1:8765") from error
    except InvalidStatus as error:
        body = (error.response.body or b"").decode("utf-8", "replace").strip()[:120]
        raise InputError(f"{address[:80]}: refused ({body or error.response.status_code}); check the token") from error
    except (OSError, TimeoutError, InvalidHandshake) as error:
        raise InputError(
            f"{address[:80]}: nothing answers ({type(error).__name__}); is the sensor running, and the port right?"
        ) from error
