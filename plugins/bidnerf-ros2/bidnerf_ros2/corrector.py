"""``Corrector``: localizes in a background thread, next to a loop at camera rate, and corrects the loop's odometry."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock

from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import Localization
from bidnerf_core.maps import Localizer


class Corrector:
    """Localizes frames in a background thread and maintains ``T_world_odom``, which corrects odometry drift.

    A loop passes frames to ``give``, which never blocks: since a localization takes longer than a frame interval, a frame is dropped if
    another one is already waiting. Each accepted pose gives a new correction, computed with the odometry of the localized frame, so the
    correction remains valid even if it arrives late. From then on, localizations start from the corrected odometry. An error of the
    localizer is raised once, by the next ``give`` or ``close``; the thread continues with later frames. All methods may be called from any
    thread. Use the corrector as a context manager, or call ``close``.
    """

    def __init__(self, localizer: Localizer) -> None:
        """Start the thread, which localizes frames with ``localizer``."""
        self.T_world_odom: SE3 | None = None  # the correction from the last accepted answer
        self.found: Localization | None = None  # the last answer, accepted or not
        self._localizer, self._lock = localizer, Lock()
        self._pool, self._pending = ThreadPoolExecutor(1, "bidnerf-corrector"), list[Future[None]]()

    def correct(self, T_odom_camera: SE3) -> SE3 | None:
        """Return T_world_camera for a pose in the odometry's frame; None until an answer has been accepted."""
        T_world_odom = self.T_world_odom
        return None if T_world_odom is None else T_world_odom @ T_odom_camera

    def give(self, frame: Frame, T_odom_camera: SE3) -> bool:
        """Submit a frame and its pose by odometry; return False if the frame was dropped because another one is already waiting.

        Raises the error of an earlier frame's localization, and ``InputError`` after ``close``.
        """
        self._raise_error()
        with self._lock:
            if len(self._pending) < 2:  # besides the frame that is being localized, one may wait
                try:
                    self._pending.append(self._pool.submit(self._localize, frame, T_odom_camera))
                except RuntimeError as error:
                    raise InputError("the corrector is closed and takes no more frames") from error
                return True
        return False

    def close(self) -> None:
        """End the thread after the current localization, whose answer still counts; a waiting frame is dropped.

        Raises any localization error that has not been raised yet.
        """
        self._pool.shutdown(cancel_futures=True)
        self._raise_error()

    def __enter__(self) -> Corrector:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _raise_error(self) -> None:
        with self._lock:
            done = [future for future in self._pending if future.done()]
            self._pending = [future for future in self._pending if future not in done]
        for future in done:
            if not future.cancelled():
                future.result()

    def _localize(self, frame: Frame, T_odom_camera: SE3) -> None:
        self.found = found = self._localizer(frame, start=self.correct(T_odom_camera))
        if found.converged:
            self.T_world_odom = found.T_world_camera @ T_odom_camera.inverse()
