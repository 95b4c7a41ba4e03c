"""The panel beside the scene: state in words, numbers, pictures, plots."""

from __future__ import annotations

import html
import math
from collections import deque

import numpy as np
import viser
from viser import uplot

from tubesight.core import Image
from tubesight.sensor import Reconstruction

# Places in the panel, from above: state and numbers, what can be done, pictures, plots.
_STATE, _NUMBERS, PLAYER, CONTROLS, _PICTURES, _PLOTS, _LAST = (float(place) for place in range(7))
# Results that the plots show.
HISTORY = 600
# Pictures in the panel are this wide.
PICTURE_PX = 800
_GOOD, _BAD = "#2e9e5b", "#d0463b"
# Wong's colours, which people with colour-blindness can tell apart.
_LINES = ("#0072b2", "#d55e00", "#009e73")
_SPAN = ("bending", "orientation")


class Panel:
    """Numbers, pictures and plots of results.

    Parameters
    ----------
    server
        Where.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._gui = server.gui
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        self._state = server.gui.add_html(badge("waiting", "no result yet", False), order=_STATE)
        self._numbers = server.gui.add_html("", order=_NUMBERS)
        self._folder = server.gui.add_folder("pictures", order=_PICTURES)
        self._picture: viser.GuiImageHandle | None = None
        self._times: deque[float] = deque(maxlen=HISTORY)
        self._values: deque[tuple[float, ...]] = deque(maxlen=HISTORY)
        with server.gui.add_folder("over time", order=_PLOTS):
            self._plots = [
                self._plot("tip, mm", ("x", "y", "z")),
                self._plot("angles, deg", _SPAN),
                self._plot("length, mm", ("length",)),
            ]
        server.gui.add_markdown("*Research use only, not a medical device.*", order=_LAST)

    def _plot(self, title: str, names: tuple[str, ...]) -> viser.GuiUplotHandle:
        series = [uplot.Series(label="s")]
        series += [uplot.Series(label=n, stroke=c, width=2) for n, c in zip(names, _LINES, strict=False)]
        empty = tuple(np.zeros(0) for _ in series)
        return self._gui.add_uplot(empty, tuple(series), title=title, aspect=2.6, scales={"x": uplot.Scale(time=False)})

    def show(self, result: Reconstruction, time_s: float, remarks: str) -> None:
        """Show state and numbers, and keep the numbers for the plots.

        Parameters
        ----------
        remarks
            Rates, latency and the like, for one line below the state.
        """
        self._state.content = badge(str(result.status), "; ".join(result.notes) or result.status.advice, bool(result))
        self._numbers.content = _numbers(result, remarks)
        self._times.append(time_s)
        self._values.append(_values(result))

    def forget(self) -> None:
        """Begin the plots anew."""
        self._times.clear()
        self._values.clear()

    def show_plots(self) -> None:
        """Bring the plots up to date; gaps where nothing was measured."""
        if self._times:
            times, values = np.array(self._times) - self._times[0], np.array(self._values)
            for plot, columns in zip(self._plots, ((0, 1, 2), (3, 4), (5,)), strict=True):
                plot.data = (times, *(values[:, c] for c in columns))

    def show_picture(self, picture: Image) -> None:
        """Show a picture (RGB)."""
        if self._picture is None:
            with self._folder:
                self._picture = self._gui.add_image(picture, format="jpeg", jpeg_quality=80)
        else:
            self._picture.image = picture


def _values(result: Reconstruction) -> tuple[float, ...]:
    if result.shape is None:
        return (math.nan,) * 6
    s = result.shape
    return (*s.tip_mm.tolist(), math.degrees(s.bending_rad), math.degrees(s.orientation_rad), s.length_mm)


def badge(word: str, text: str, good: bool) -> str:
    """HTML of a word on green or red, and a sentence."""
    colour = _GOOD if good else _BAD
    return (
        f'<div style="margin:0.4em 0.8em"><span style="background:{colour};color:white;border-radius:0.4em;'
        f'padding:0.15em 0.6em;font-weight:600">{html.escape(word)}</span> '
        f'<span style="font-size:0.85em">{html.escape(text)}</span></div>'
    )


def _numbers(result: Reconstruction, remarks: str) -> str:
    rows = [("pair", html.escape(result.frame), "")]
    if result.shape is not None:
        s, sd = result.shape, result.shape.sd
        rows += [(f"tip {n}", f"{v:.3f}", _plus(sd[f"tip_{n}"], "mm", 1)) for n, v in zip("xyz", s.tip_mm, strict=True)]
        rows += [
            ("bending", f"{math.degrees(s.bending_rad):.3f}", _plus(sd["bending"], "&deg;", 180 / math.pi)),
            ("orientation", _angle(s.orientation_rad), _plus(sd["orientation"], "&deg;", 180 / math.pi)),
            ("length", f"{s.length_mm:.3f}", _plus(sd["length"], "mm", 1)),
            ("curve", html.escape(result.curve.model if result.curve is not None else ""), _rms(result.fit_rms_px)),
        ]
    right = "text-align:right;font-variant-numeric:tabular-nums;padding:0 0.8em"
    body = "".join(
        f'<tr><td>{name}</td><td style="{right}">{value}</td><td style="opacity:0.75">{more}</td></tr>'
        for name, value, more in rows
    )
    line = f'<div style="font-size:0.85em;opacity:0.8">{html.escape(remarks)}</div>'
    return f'<div style="margin:0.4em 0.8em"><table style="font-size:0.95em">{body}</table>{line}</div>'


def _rms(rms_px: float) -> str:
    return f"rms {rms_px:.2f} px"


def _angle(radians: float) -> str:
    return f"{math.degrees(radians):.3f}" if math.isfinite(radians) else "undefined"


def _plus(sd: float, unit: str, scale: float) -> str:
    """Two deviations in words: what 19 of 20 errors stay below."""
    return f"&plusmn; {2 * sd * scale:.3f} {unit}" if math.isfinite(sd) else unit
