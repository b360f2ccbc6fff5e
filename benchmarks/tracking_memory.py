"""Track thousands of frames in one tracker and record its memory: a sequence forwards, backwards, forwards again, and so on.

    python benchmarks/tracking_memory.py MAP SEQUENCE --frames 10000 --name tracking_memory

The sequence is read once and its frames are repeated at the intervals at which they were taken, so that any growth of memory
is the tracker's. In every thousand frames the camera is covered for five, so that losses and searches are included. With
``--no-depth`` the tracker sees only colours. Everything runs in one process of one thread.
"""

from __future__ import annotations

import argparse
import gc
import os
import statistics
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import torch
from tracking import RESULTS, WRONG, sift_milliseconds
from tracking_runs import Frames, covered_frame

from bidnerf_core import Localizer, Tracker, load_map
from bidnerf_core.datasets import TimedFrame, open_sequence
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.results.errors import pose_error

EVERY = 1000
"""The number of frames after which memory is read."""
COVERED = range(500, 505)
"""The frames of every thousand that see nothing."""


def back_and_forth(frames: Frames, count: int) -> Iterator[TimedFrame]:
    """Yield ``count`` frames: the sequence forwards, backwards, and so on; time advances by the true intervals."""
    around = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    now, before = 0.0, frames[0]
    for number in range(count):
        timed = frames[around[number % len(around)]]
        if timed.time is not None and before.time is not None:
            now += abs(timed.time - before.time)
        before = timed
        yield replace(timed, time=None if timed.time is None else now)


def resident_bytes() -> int:
    """Return the physical memory that this process occupies."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def tracked(tracker: Tracker, frames: Iterator[TimedFrame], depth: bool) -> Iterator[dict[str, Any]]:
    """Track the frames; yield one row per thousand."""
    generator = torch.Generator().manual_seed(0)
    milliseconds, counts = list[float](), dict.fromkeys(("accepted", "wrong", "accepted_while_covered"), 0)
    for number, timed in enumerate(frames, start=1):
        hidden = (number - 1) % EVERY in COVERED
        frame = covered_frame(timed.frame, generator) if hidden else timed.frame
        frame = frame if depth else replace(frame, depth=None)
        began = time.process_time()
        found = tracker(frame, timed.time)
        milliseconds.append(1000 * (time.process_time() - began))
        if found.converged and timed.truth is not None:
            error = pose_error(found.T_world_camera, timed.truth)
            counts["accepted_while_covered"] += hidden
            counts["accepted"] += not hidden
            counts["wrong"] += bool(error.translation > WRONG[0] or error.rotation_deg > WRONG[1])
        if number % EVERY == 0:
            cpu = {"median": statistics.median(milliseconds), "mean": statistics.mean(milliseconds)}
            objects = len(gc.get_objects())
            yield {
                "frames": number, "resident_bytes": resident_bytes(), "python_objects": objects, "cpu_ms": cpu,
            } | counts  # fmt: skip
            milliseconds, counts = [], dict.fromkeys(counts, 0)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path, help="folder of a map with landmarks")
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--frames", type=int, default=10_000, help="number of frames to track")
    parser.add_argument("--no-depth", action="store_true", help="show colours alone")
    parser.add_argument("--name", default="tracking_memory", help="of the record")
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    frames = list(open_sequence(given.sequence))
    tracker = Tracker(Localizer(load_map(given.map)))
    results: dict[str, Any] = {
        "sequence": given.sequence.name, "depth": not given.no_depth, "sift_cpu_ms": sift_milliseconds(),
        "resident_bytes_before": resident_bytes(), "rows": [],
    }  # fmt: skip
    for row in tracked(tracker, back_and_forth(frames, given.frames), not given.no_depth):
        results["rows"].append(row)
        print(
            f"{row['frames']} frames: {row['resident_bytes'] / 2**20:.1f} MiB, {row['python_objects']} objects,"
            f" {row['accepted']} accepted, {row['wrong']} wrong, {row['accepted_while_covered']} while covered,"
            f" {row['cpu_ms']['mean']:.0f} ms (median {row['cpu_ms']['median']:.0f})",
            flush=True,
        )
    print(write_record(RESULTS / f"{given.name}.json", results, seed=0))


if __name__ == "__main__":
    main()
