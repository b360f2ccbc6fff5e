"""Defects that an earlier search with hostile inputs found and that only processes show: signals, pipes, limits of memory.

Those that show in one process are tests of the parts that had them.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bidnerf import Frame
from damage import zeros_png
from harness import (
    AUTO,
    QUICK,
    SECONDS,
    Check,
    Checks,
    Door,
    Outcome,
    begin,
    defects,
    end,
    run,
    sound_folder,
)


class Work:
    """Sound files, copies of them to be damaged, and the outcome of the last case."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.sound, self._count = folder, folder / "sound", 0
        self.sound.mkdir()
        sound_folder(self.sound, test=8)

    def copy(self) -> Path:
        self._count += 1
        return Path(shutil.copytree(self.sound, self.folder / f"copy{self._count}"))

    def case(self, name: str, door: Door, **options: Any) -> Check:
        """Run a case, which must end in any sound way."""
        return Check(name, tuple(defects(self.run(door, **options))))

    def run(self, door: Door, seconds: float = SECONDS, **options: Any) -> Outcome:
        return run(door, self.folder / "case", seconds, **options)


def poses_lost(work: Work) -> Checks:
    """1: ``localize --out`` loses every pose unless the stop is Ctrl-C."""
    here = work.copy()
    slow = ["--json", "--perturb", "0.1", "5", "--method", "bid", "--max-steps", "150", "--rays", "256"]

    def kept(name: str, found: Outcome, least: int, path: Path) -> Check:
        number = len(json.loads(path.read_text())) if path.exists() else 0
        said = len(found.out.splitlines())
        wrong = [f"{number} poses in the file of {max(said, least)}"] if number < max(said, least) else []
        return Check(name, tuple(wrong + (["a traceback"] if "Traceback" in found.err else [])))

    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        out, log = here / f"{number.name}.json", here / "stop.log"
        child = begin(["localize", here / "map", here / "data", "--out", out, *slow], log)
        until = time.monotonic() + SECONDS
        said = log.with_suffix(".out")
        while not (said.exists() and said.read_text().count("\n") >= 3) and time.monotonic() < until:
            time.sleep(0.01)
        os.kill(child, number)
        yield kept(number.name, end(child, log), 3, out)
    words = ["localize", here / "map", here / "data", "--perturb", "0.1", "5", *QUICK, "--out"]
    for name, more in (("closed pipe", []), ("closed pipe, --json", ["--json"])):
        out = here / f"{name}.json"
        reading, writing = os.pipe()
        os.close(reading)
        found = work.run([*words, out, *more], out=writing)
        os.close(writing)
        yield kept(name, found, 1, out)
    found = work.run([*words, here / "full.json"], out=Path("/dev/full"))
    yield kept("stdout on a full disk", found, 1, here / "full.json")


def trajectories_lost(work: Work) -> Checks:
    """2: ``track --out`` loses the trajectory on a signal."""
    here = work.copy()
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        out, log = here / f"{number.name}.json", here / "track.log"
        began = time.monotonic()
        whole = work.run(["track", here / "map", here / "data", "--out", here / "whole.json"])
        seconds = time.monotonic() - began
        child = begin(["track", here / "map", here / "data", "--out", out], log)
        time.sleep(0.8 * seconds)
        os.kill(child, number)
        found = end(child, log)
        rows = len(json.loads(out.read_text())) if out.exists() else 0
        wrong = [] if rows or found.ending == "done" else ["no frame in the file"]
        yield Check(f"track, {number.name}", tuple(wrong + defects(whole)))


def memory_of_inputs(work: Work) -> Checks:
    """3: a small file of many pixels, and a description of many cameras, take gigabytes."""
    here = work.copy()
    (here / "large.png").write_bytes(zeros_png(9900, 6, 4))  # 98 megapixels, RGBA
    limit = 5 * 2**29
    yield work.case(
        "largest=640",
        lambda: Frame.open(here / "large.png", hfov=41.0, largest=640),
        memory=limit,
        seconds=60,
    )
    yield work.case("whole", lambda: Frame.open(here / "large.png", hfov=41.0), memory=3 * 2**30, seconds=60)
    path = here / "map" / "map.json"
    plain = json.loads(path.read_text())
    cameras = [plain["cameras"][n % len(plain["cameras"])] | {"name": f"{n:06}"} for n in range(200_000)]
    path.write_text(json.dumps(plain | {"cameras": cameras}))
    yield work.case("info, 200,000 cameras", ["info", here / "map"])
    words = ["localize", here / "map", here / "photo.png", "--hfov", "40", *AUTO]
    yield work.case("localize, 200,000 cameras", words)


FINDINGS: tuple[Callable[[Work], Checks], ...] = (poses_lost, trajectories_lost, memory_of_inputs)
