"""The sensor in use, which people may change while it measures."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

from tubesight.core import Array
from tubesight.sensor import ShapeSensor


class SensorSwitch:
    """Hands over to the measuring thread what people on other threads chose last.

    Parameters
    ----------
    sensor
        To begin with.
    prepare
        Called with each new sensor before it is used, on the thread of whoever chose it.
    changed
        Called after each choice.

    Attributes
    ----------
    current
        What measures; changes in `adopt` alone, so that on the measuring thread it is also what made the last result.
    """

    def __init__(
        self,
        sensor: ShapeSensor,
        prepare: Callable[[ShapeSensor], None] = lambda sensor: None,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        self.current = sensor
        self._chosen, self._prepare, self._changed = sensor, prepare, changed
        self._lock = threading.Lock()

    def use(self, method: str) -> None:
        """Choose another method."""
        with self._lock:
            chosen = replace(self._chosen, method=method)
            self._prepare(chosen)
            self._chosen = chosen
        self._changed()

    def mark(self, camera: str, px: Array) -> None:
        """Mark the tube's base (2,) in a camera's pictures."""
        with self._lock:
            self._chosen = replace(self._chosen, base_px={**self._chosen.base_px, camera: px})
        self._changed()

    def adopt(self) -> bool:
        """Measure from here on with what was chosen last; whether that is another sensor than before."""
        before, self.current = self.current, self._chosen
        return self.current is not before
