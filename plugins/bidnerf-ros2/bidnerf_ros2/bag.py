"""ROS 2 bags (folders with ``metadata.yaml``, files ``.mcap`` and ``.db3``) and ROS 1 bags (``.bag``) as
sequences.

Images come from the topic with the most colour images that has a matching camera info: ``/camera/image_raw``
goes with ``/camera/camera_info``. Depth comes from the topic of depth images with the same aspect ratio; each
image gets the depth nearest in time, within half the usual interval of the faster of the two. Times are those
of the message headers. A bag has no poses for its images, so it can be tracked, but no map can be trained
from it.
"""

from __future__ import annotations

import logging
import weakref
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

from bidnerf_core.camera import Intrinsics, same_aspect
from bidnerf_core.datasets import BreaksOff, Capture, DatasetOptions, Reader, Shot
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_ros2.conversions import seconds
from bidnerf_ros2.messages import frame_of, intrinsics, is_depth

log = logging.getLogger("bidnerf")

METADATA, SUFFIXES = "metadata.yaml", (".bag", ".mcap", ".db3")
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO = "sensor_msgs/msg/CameraInfo"
WAITING = 30
"""Number of images that may wait for their depth, which is recorded with a delay."""


@dataclass(frozen=True)
class Topics:
    """The topics of a bag that form a sequence."""

    image: str
    info: str
    depth: str | None
    camera: Intrinsics
    frames: int  # number of messages in the image topic
    interval: float  # seconds, the mean of the images or of depth, whichever come faster


class Bag:
    """The images of a bag in chronological order, with the depth of each, decoded one after another."""

    def __init__(self, path: Path, topics: Topics) -> None:
        self._path, self._topics = path, topics
        self._decoded: Iterator[tuple[Any, Any | None]] = iter(())
        self._next = 0  # number of the next image to decode
        self._begun: list[Any] = []  # the iterator, which is closed before the interpreter ends
        weakref.finalize(self, _close, self._begun)

    def read(self, number: int) -> tuple[Any, Any | None]:
        """Return the message of an image, and that of its depth. Raises ``BreaksOff`` if the bag ends before it."""
        if number < self._next or self._next == 0:
            _close(self._begun)
            self._decoded, self._next = self._paired(), 0
            self._begun.append(self._decoded)
        try:
            for found in self._decoded:
                self._next += 1
                if self._next > number:
                    return found
        except InputError as error:
            raise BreaksOff(error) from error
        raise BreaksOff(f"ends before image {number}", where=self._path, expected="a complete bag")

    def _paired(self) -> Iterator[tuple[Any, Any | None]]:
        """Yield images with their depth, once the depth can have been recorded."""
        images: deque[tuple[float, Any]] = deque()
        depths: deque[tuple[float, Any]] = deque(maxlen=2 * WAITING)
        for topic, time, message in _messages(self._path, (self._topics.image, self._topics.depth)):
            (images if topic == self._topics.image else depths).append((time, message))
            while images and (self._is_complete(images[0][0], depths) or len(images) > WAITING):
                yield self._with_depth(*images.popleft(), depths)
        for image in images:
            yield self._with_depth(*image, depths)

    def _is_complete(self, time: float, depths: deque[tuple[float, Any]]) -> bool:
        return self._topics.depth is None or any(other >= time for other, _ in depths)

    def _with_depth(self, time: float, image: Any, depths: deque[tuple[float, Any]]) -> tuple[Any, Any | None]:
        nearest = min(depths, key=lambda depth: abs(depth[0] - time), default=None)
        # The times of an image and its depth may always differ by 20 ms.
        close = nearest is not None and abs(nearest[0] - time) <= max(0.02, self._topics.interval / 2)
        return image, nearest[1] if nearest is not None and close else None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the open bag, which another process cannot use."""
        return {**self.__dict__, "_decoded": iter(()), "_next": 0, "_begun": []}


def _close(iterators: list[Any]) -> None:
    while iterators:
        iterators.pop().close()


@dataclass(frozen=True, eq=False, kw_only=True)
class BagShot(Shot):
    """An image of a bag."""

    camera: Intrinsics
    bag: Bag
    number: int

    def frame(self, background: tuple[float, float, float] = (0.0, 0.0, 0.0), side: int | None = None) -> Frame:
        """Decode the image and its depth."""
        image, depth = self.bag.read(self.number)
        found = frame_of(image, self.camera, depth, self.name)
        return found if side is None else found.at_most(side)


class BagReader(Reader):
    """The reader for bags."""

    accepts = ("camera",)
    suffixes = SUFFIXES
    may_lack_poses = True

    @property
    def expected(self) -> str:
        """The files of a bag."""
        return "metadata.yaml and its .mcap or .db3 (a bag of ROS 2), or a file .bag, .mcap or .db3"

    def recognises(self, path: Path) -> bool:
        """Return whether a folder is a ROS 2 bag, or a file is a bag by its name."""
        return (path / METADATA).is_file() or (path.is_file() and path.suffix.lower() in SUFFIXES)

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Return the images of a bag, without poses.

        Raises ``InputError`` for a bag without images and matching camera infos.
        """
        topics, given = _topics(path), options.given_camera
        if given is not None and not isinstance(given, Intrinsics):
            raise InputError("a bag has its own camera;", where=path, expected="Intrinsics to replace it")
        depth = "no depth" if topics.depth is None else f"depth of {topics.depth}"
        log.info("%s: images of %s, camera of %s, %s", path, topics.image, topics.info, depth)
        bag, camera = Bag(path, topics), given or topics.camera
        times = (time for _, time, _ in _messages(path, (topics.image,)))
        shots = [
            BagShot(bag=bag, number=number, camera=camera, time=time, stem=f"{number:06d}")
            for number, time in enumerate(times)
        ]
        tracked = f"'bidnerf track MAP {path}', or a dataset with poses"
        return Capture(path, shots, options.colour, poses_expected=tracked)


def _messages(path: Path, names: tuple[str | None, ...]) -> Iterator[tuple[str, float, Any]]:
    """Yield the topic, time and content of each message of some topics. Raises ``InputError`` for a damaged bag."""
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            wanted = [connection for connection in bag.connections if connection.topic in names]
            for connection, recorded, raw in bag.messages(wanted):
                message: Any = bag.deserialize(raw, connection.msgtype)
                time = seconds(message.header.stamp)
                yield connection.topic, time or recorded * 1e-9, message
    except InputError:
        raise
    except Exception as error:  # the formats' parsers may raise anything
        raise InputError(f"the bag cannot be read ({type(error).__name__}: {error})", where=path) from error


def _first(path: Path, topic: str) -> Any:
    """Return the first message of a topic. Raises ``InputError`` if the bag declares messages but has none."""
    for _, _, message in _messages(path, (topic,)):
        return message
    raise InputError(f"has no message of {topic}, although it declares some; is it truncated?", where=path)


def _topics(path: Path) -> Topics:
    """Choose the topics of a bag."""
    counts, infos, span = dict[str, int](), set[str](), 0.0
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
            span = bag.duration * 1e-9
            for connection in bag.connections:
                if connection.msgtype in IMAGES and connection.msgcount:
                    counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
                elif connection.msgtype == INFO and connection.msgcount:
                    infos.add(connection.topic)
    except (AnyReaderError, OSError, ValueError, KeyError) as error:
        raise InputError(f"not a readable bag ({error})", where=path, expected=BagReader().expected) from error
    first = {topic: _first(path, topic) for topic in (*counts, *infos)}
    colour = [t for t in counts if not is_depth(first[t]) and _info_beside(t, infos) in infos]
    if not colour:
        listed = ", ".join(sorted({*counts, *infos})) or "none"
        raise InputError(
            "no topic of colour images with a matching camera_info",
            where=path,
            expected=f"one; its images and infos: {listed}",
        )
    image = max(colour, key=lambda topic: (counts[topic], not hasattr(first[topic], "format")))
    info = _info_beside(image, infos)
    camera = intrinsics(first[info], rectified="rect" in image.rpartition("/")[2])
    depths = [t for t in counts if is_depth(first[t]) and _fits(first[t], camera)]
    others = [t for t in depths if (i := _info_beside(t, infos)) in infos and not _same_lens(first[i], camera)]
    if others:
        log.info("%s: depth of %s is that of another camera and is left out", path, ", ".join(others))
    registered = [topic for topic in depths if topic not in others]
    depth = max(registered, key=lambda topic: ("aligned" in topic, counts[topic]), default=None)
    return Topics(image, info, depth, camera, counts[image], span / max(counts[image], counts[depth]) if depth else 0.0)


def _info_beside(image: str, infos: set[str]) -> str:
    """Return the camera info for a topic of images: in its namespace, or one above for compressed images."""
    namespace = image.rpartition("/")[0]
    names = [f"{space}/camera_info" for space in (namespace, namespace.rpartition("/")[0])]
    return next((name for name in names if name in infos), names[0])


def _same_lens(info: Any, camera: Intrinsics) -> bool:
    """Return whether the camera info of a depth topic is that of the colour camera, to which depth is then registered."""
    own = intrinsics(info, rectified=True).resized(camera.width, camera.height)
    shift = abs(own.cx - camera.cx) + abs(own.cy - camera.cy)
    return abs(own.fx / camera.fx - 1) < 0.01 and shift < 0.02 * camera.width


def _fits(depth: Any, camera: Intrinsics) -> bool:
    if hasattr(depth, "format"):
        return True  # its size is known once it is decoded
    return same_aspect((int(depth.width), int(depth.height)), (camera.width, camera.height))


reader = BagReader()
