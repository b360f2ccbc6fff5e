"""The time between frames."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Any

from bidnerf_core.errors import InputError
from bidnerf_core.io.json import LARGEST_NUMBER


@dataclass(frozen=True)
class Clock:
    """The time of the last frame. Frames without a time stamp come at the interval of the last two that had one."""

    now: float | None  # seconds, from any origin
    interval: float  # seconds
    stamped: bool = True  # whether the last frame had a time stamp

    def step(self, time: Any) -> tuple[Clock, float]:
        """Return the clock at the next frame, and the seconds since the last one: negative if it came out of order.

        ``time`` is in seconds, or None. Raises ``InputError`` for anything else, and for a time that is not finite.
        """
        if time is None:
            now = None if self.now is None else self.now + self.interval
            return Clock(now, self.interval, stamped=False), self.interval
        is_number = isinstance(time, Real) and not isinstance(time, bool)
        if not is_number or not abs(time) <= LARGEST_NUMBER:
            raise InputError(f"time of the frame is {str(time)[:40]!r}, expected seconds or None")
        time = float(time)
        if self.now is None:
            return Clock(time, self.interval), self.interval
        seconds = time - self.now
        return Clock(time, seconds if seconds > 0 else self.interval), seconds
