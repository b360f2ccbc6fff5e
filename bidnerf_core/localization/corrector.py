"""``Corrector``: localizes in a background thread, next to a loop at camera rate, and corrects the loop's odometry."""

from __future__ import annotations

import threading
from types import TracebackType

from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.localizer import Localizer
from bidnerf_core.localization.result import Localization


class Corrector:
    """Localizes frames in a background thread and maintains ``T_world_odom``, which corrects odometry drift.

    A loop passes frames to ``give``, which never blocks: a localization takes longer than a frame, so a frame is dropped if
    another is already waiting. Each accepted pose gives a new correction, computed with the odometry of the localized frame, so
    it may arrive late. From then on, localizations start from the corrected odometry. An error of the localizer is raised once,
    by the next ``give`` or ``close``; the thread continues with later frames. All methods may be called from any thread. Use it
    as a context manager, or call ``close``.
    """

    def __init__(self, localizer: Localizer) -> None:
        """Start the thread."""
        self._localizer = localizer
        self._changed = threading.Condition()
        self._waiting: tuple[Frame, SE3] | None = None
        self._closed = False
        self._error: BaseException | None = None
        self._found: Localization | None = None
        self._T_world_odom: SE3 | None = None
        self._thread = threading.Thread(target=self._run, name="bidnerf-corrector", daemon=True)
        self._thread.start()

    @property
    def T_world_odom(self) -> SE3 | None:
        """The correction from the last accepted answer; None until there is one."""
        return self._T_world_odom

    @property
    def found(self) -> Localization | None:
        """The last answer, accepted or not; None until there is one."""
        return self._found

    def corrected(self, T_odom_camera: SE3) -> SE3 | None:
        """Return T_world_camera for a pose in the odometry's frame; None until an answer has been accepted."""
        T_world_odom = self._T_world_odom
        return None if T_world_odom is None else T_world_odom @ T_odom_camera

    def give(self, frame: Frame, T_odom_camera: SE3) -> bool:
        """Submit a frame and its pose by odometry; return False if it was dropped because another is already waiting.

        Raises the error of an earlier frame's localization, and ``InputError`` after ``close``.
        """
        with self._changed:
            self._raise_error()
            if self._closed:
                raise InputError("the corrector is closed and takes no more frames")
            if self._waiting is not None:
                return False
            self._waiting = frame, T_odom_camera
            self._changed.notify_all()
            return True

    def close(self) -> None:
        """End the thread after the current localization, whose answer still counts; a waiting frame is dropped.

        Raises the error of a localization that has not been raised yet.
        """
        with self._changed:
            self._closed, self._waiting = True, None
            self._changed.notify_all()
        self._thread.join()
        with self._changed:
            self._raise_error()

    def __enter__(self) -> Corrector:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _run(self) -> None:
        while (taken := self._next()) is not None:
            frame, T_odom_camera = taken
            try:
                found = self._localizer(frame, start=self.corrected(T_odom_camera))
            except BaseException as error:  # raised in the caller's thread
                with self._changed:
                    self._error = error
                continue
            self._found = found
            if found.converged:
                self._T_world_odom = found.T_world_camera @ T_odom_camera.inverse()

    def _next(self) -> tuple[Frame, SE3] | None:
        """Wait for a frame; return None once the corrector is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._waiting is not None)
            taken, self._waiting = self._waiting, None
            return taken
