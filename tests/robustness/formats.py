"""Every count of a COLMAP model and every field of a saved tracker state, damaged one at a time."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from bidnerf_core.datasets import open_sequence
from damage import OTHER_VALUES, at, false_counts, joined, parts_of, places_of, replaced_at, with_count
from harness import SMALL_FIELD, Check, Checks, Door, defects, run, tracker, views_of

LARGE_NUMBERS = ("1e400", "-1e308", "NaN", "1" + "0" * 400)


INNER_COUNTS = {  # of the keypoints of an image, and of the track of a point
    "images.bin": 8 + struct.calcsize("<I7dI") + len("1.png\0"),
    "points3D.bin": 8 + struct.calcsize("<q3d3Bd"),
}


def colmap_counts(sound: Path, work: Path) -> Checks:
    """Give false counts to the files of a model, and to the keypoints of an image and the track of a point."""
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        content = (sound / "colmap" / "sparse" / "0" / name).read_bytes()
        damaged = false_counts(content)
        if name in INNER_COUNTS:
            for number in (2**63, -1, 2**31, 10**6, 0):
                damaged[f"inner count {number}"] = with_count(number, content, INNER_COUNTS[name])
        if name == "images.bin":
            damaged["name without an end"] = content.replace(b"\0", b"x")
        if name == "cameras.bin":
            damaged |= {f"size {side}": with_count(side, content, 16) for side in (2**63, -1, 0, 2**31)}
        for kind, bad in damaged.items():
            here = work / "colmap"
            shutil.copytree(sound / "colmap", here)
            (here / "sparse" / "0" / name).write_bytes(bad)
            new = ["--out", work / "new", "--overwrite", *SMALL_FIELD, "--steps", "2", "--no-bake"]
            doors: dict[str, Door] = {
                "views": partial(views_of, here),
                "train": ["train", here, *new],
                "localize": ["localize", sound / "map", sound / "data", "--depth-points", here / "sparse/0"],
            }
            for door, call in doors.items():
                yield Check(f"{name}, {kind}: {door}", tuple(defects(run(call, work / "case"))))
            shutil.rmtree(here)


def states(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield the state with each of its numbers and tensors damaged in turn."""
    header, numbers = parts_of(content)
    text = header["__metadata__"]["bidnerf"].encode()

    def with_text(changed: bytes) -> bytes:
        metadata = {"__metadata__": {"bidnerf": changed.decode(errors="surrogatepass")}}
        return joined(header | metadata, numbers)

    plain = json.loads(text)
    for place in places_of(plain):
        name = ".".join(map(str, place))
        for value in (*map(json.dumps, OTHER_VALUES), *LARGE_NUMBERS):
            yield f"{name} = {value[:20]}", with_text(replaced_at(text, place, value))
        left = json.loads(text)
        del at(left, place[:-1])[place[-1]]
        yield f"without {name}", with_text(json.dumps(left).encode())
    for name in [name for name in header if name != "__metadata__"]:
        begin, stop = header[name]["data_offsets"]
        filled = {"all bits set": b"\xff", "zeros": b"\0", "large": b"\x7e", "negative": b"\xfe"}
        for kind, byte in filled.items():
            yield f"{name}: {kind}", joined(header, numbers[:begin] + byte * (stop - begin) + numbers[stop:])
        shape = header[name]["shape"]
        for other in ([*shape, 1], shape[::-1], [1, *shape], [stop - begin]):
            bad = header | {name: header[name] | {"shape": other}}
            if other == [stop - begin]:
                bad[name] |= {"dtype": "U8"}
            yield f"{name}: shape {other}", joined(bad, numbers)
        renamed = {n if n != name else "other": entry for n, entry in header.items()}
        yield f"without {name}", joined(renamed, numbers)


def tracker_states(sound: Path, work: Path) -> Checks:
    """Restore a tracker from each damaged state, and track two frames more."""
    frames = list(open_sequence(sound / "data"))[:6]
    before, path = tracker(sound, frames[0].truth), work / "state"  # a start, so that there is a motion
    for timed in frames[:4]:
        before(timed.frame, timed.time)
    before.save(path)
    after = tracker(sound)

    def restored() -> None:
        after.restore(path)
        for timed in frames[4:]:
            after(timed.frame, timed.time)

    content = path.read_bytes()
    for name, bad in [("sound", content), *states(content)]:
        path.write_bytes(bad)
        yield Check(f"tracker state, {name}", tuple(defects(run(restored, work / "case"))))
