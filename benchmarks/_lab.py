"""What the benchmarks share: test frames, arguments, answers and how they are counted, turns, and records."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import cv2
import torch
from scipy.stats import chi2

from bidnerf import Localization, Map, View, load_map
from bidnerf.evaluation import provenance, script_command
from bidnerf.results import normalized_error_squared, pose_error, success_rate
from bidnerf_core.datasets import Capture, open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.io import FileInUse, take_lock, to_plain, write_file

RESULTS = Path(__file__).resolve().parent / "results"
LIMITS = {"5deg 0.05": (0.05, 5.0), "1deg 0.02": (0.02, 1.0)}
"""The largest errors (metres or scene units, degrees) of an answer that is right, and of one that is strictly right."""
RIGHT, STRICT = LIMITS
BOUND = float(chi2.ppf(0.95, 6))
"""Normalised squared error below which nineteen of twenty errors lie if the covariance is right."""

FRAMES = 24
"""Frames of each map and mode that ``answers.py`` shows under a condition whose share is 1."""
FEWEST = 15
"""Number of frames without those for tuning from which the latter are left out."""
CONFIG = {"steps": 1500, "seed": 0}
"""Settings with which ``answer_maps.py`` trains maps."""
VERSION = 1
"""Goes up with every change of the code that changes maps."""

Row = dict[str, Any]


def held_out(names: Sequence[str], tuning: bool = False, count: int | None = None) -> list[str]:
    """Return ``count`` evenly spaced frames of a test split: those on which settings are tuned, or all others, for reports.

    Frames whose index is 1 modulo 5 are for tuning.
    """
    chosen = [name for place, name in enumerate(names) if (place % 5 == 1) == tuning]
    return spread(chosen, count or len(chosen))


def spread(names: Sequence[str], count: int) -> list[str]:
    """Return ``count`` evenly spaced names, or all if there are fewer."""
    count = min(count, len(names))
    return [names[place * len(names) // count] for place in range(count)]


def without_tuning(names: Sequence[str]) -> list[str]:
    """Return the frames of a test split without those for tuning, or all if fewer than ``FEWEST`` would remain."""
    others = held_out(names)
    return others if len(others) >= FEWEST else list(names)


def one_thread() -> None:
    """Run everything in this process on one thread, so that times can be compared."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


def parser(
    doc: str | None, name: str | None = None, scenes: bool = False, named: bool = True
) -> argparse.ArgumentParser:
    """Return a parser that shows a script's docstring, with the name of its record (required if there is no default)."""
    found = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if named:
        found.add_argument("--name", default=name, required=name is None, help="of the record (default: %(default)s)")
    if scenes:
        found.add_argument(
            "scenes",
            nargs="+",
            metavar="SCENE",
            help="MAP:DATA, folders of a map and of its dataset, or a name as answer_maps.py takes it",
        )
        found.add_argument("--frames", type=int, help="test frames of each scene, evenly spaced (default: all)")
        found.add_argument("--tuning-frames", action="store_true", help="only frames that settings are tuned on")
    return found


# Datasets, and maps of them.


def folder_of(variable: str) -> Path:
    """Return the folder that a variable of the environment names."""
    value = os.environ.get(variable)
    if not value:
        raise InputError(f"{variable} is not set, expected a folder")
    return Path(value)


def data_folder(scene: str) -> Path:
    """Return the folder of the dataset of SCENE, SCENE@K or SCENE@new."""
    return folder_of("BIDNERF_DATA") / scene.partition("@")[0]


def capture_of(scene: str, background: tuple[float, float, float] | None = None) -> Capture:
    """Return the dataset of SCENE, that of SCENE@K with half K of its training images, or that of SCENE@new.

    SCENE@new is trained on every second training image. Held out are the others, if they have depth where the test images have,
    and the test images that ``answers.py`` does not show under the name SCENE.
    """
    capture, part = open_dataset(data_folder(scene), background), scene.partition("@")[2]
    train = [place for place, shot in enumerate(capture.shots) if "train" in shot.splits]
    if part == "new":
        test = [place for place, shot in enumerate(capture.shots) if "test" in shot.splits]
        shown = set(spread(without_tuning(capture.frame_names("test")), FRAMES))
        left = [place for place in test if capture.shots[place].name not in shown]
        if (capture.shots[train[0]].depth is None) == (capture.shots[test[0]].depth is None):
            left += train[1::2]
        splits = dict.fromkeys(train[::2], "train") | dict.fromkeys(left, "test")
        shots = [replace(capture.shots[place], splits=(split,)) for place, split in sorted(splits.items())]
        return replace(capture, shots=shots)
    left_out = set(random.Random(int(part)).sample(train, len(train) // 2)) if part else set()
    return replace(capture, shots=[shot for place, shot in enumerate(capture.shots) if place not in left_out])


def map_folder(scene: str) -> Path:
    """Return the folder of a scene's map, whether the map has been trained or not."""
    data = data_folder(scene)
    if not data.is_dir():
        raise InputError(f"{data}: no such folder, expected a dataset; BIDNERF_DATA names the folder of all")
    hashed = hashlib.blake2b(json.dumps([VERSION, CONFIG], sort_keys=True).encode(), digest_size=6)
    for path in sorted(path for path in data.rglob("*") if path.is_file()):
        with path.open("rb") as file:
            hashed.update(str(path.relative_to(data)).encode() + hashlib.file_digest(file, "blake2b").digest())
    return folder_of("BIDNERF_MAPS") / f"{scene}-{hashed.hexdigest()}"


def require_map(scene: str) -> Path:
    """Return the folder of a scene's map. Raises ``InputError`` if it has not been trained."""
    folder = map_folder(scene)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such map, expected one; answer_maps.py {scene} trains it")
    return folder


@dataclass(frozen=True)
class Scene:
    """A map and the dataset that it was made from."""

    folder: Path
    data: Path
    map: Map
    dataset: Capture

    @classmethod
    def open(cls, pair: str) -> Scene:
        """Open ``MAP:DATA``, or a scene that ``answer_maps.py`` has trained, by name."""
        if ":" in pair:
            folder, data = map(Path, pair.split(":", 1))
            stored = load_map(folder)
            return cls(folder, data, stored, open_dataset(data, stored.bounds.background))
        folder, data = require_map(pair), data_folder(pair)
        stored = load_map(folder)
        return cls(folder, data, stored, capture_of(pair, stored.bounds.background))

    @property
    def name(self) -> str:
        return self.data.name

    @property
    def key(self) -> list[Any]:
        """What identifies the scene in a file of rows: its name, and the content of its map."""
        info = self.map.info
        return [self.name, info.weights, str(info.landmarks), str(info.surface)]

    def views(self, tuning: bool = False, count: int | None = None) -> list[View]:
        return self.dataset.views("test", held_out(self.dataset.frame_names("test"), tuning, count))


def without_depth(view: View) -> View:
    return replace(view, frame=view.frame.replace(depth=None))


def modes(views: Sequence[View], wanted: Iterable[str] = ("RGB", "RGB-D")) -> dict[str, list[View]]:
    """Return the views without their depth and, where they have any, with it."""
    found = {"RGB": [without_depth(view) for view in views]}
    if any(view.frame.has_depth for view in views):
        found["RGB-D"] = list(views)
    return {mode: some for mode, some in found.items() if mode in wanted}


# Answers.


def errors_of(found: Localization, truth: View | None) -> Row:
    """Return an answer's errors, and the squared error that its covariance normalises; None for each that is not known."""
    names = ("translation", "rotation_deg", "normalized_error_squared")
    if truth is None or not found.T_world_camera.is_finite:
        return dict.fromkeys(names)
    error, squared = pose_error(found.T_world_camera, truth.T_ref_camera), None
    if found.covariance is not None:
        value = float(normalized_error_squared(found.T_world_camera, truth.T_ref_camera, found.covariance))
        squared = value if 0 <= value < float("inf") else None
    return dict(zip(names, (float(error.translation), float(error.rotation_deg), squared), strict=True))


def answer(localize: Callable[[], Localization], truth: View | None) -> Row:
    """Localize once; return the errors of the answer, whether it was accepted, and its CPU time."""
    began = time.process_time()
    found = localize()
    seconds = time.process_time() - began
    judged = {"converged": found.converged, "outcome": str(found.outcome), "cpu_seconds": seconds}
    return errors_of(found, truth) | judged


def within(row: Row, limits: str | tuple[float, float] = RIGHT) -> bool:
    """Return whether an answer is within the limits of its errors; an answer without a pose is not."""
    metres, degrees = LIMITS[limits] if isinstance(limits, str) else limits
    return row["translation"] is not None and row["translation"] < metres and row["rotation_deg"] < degrees


def rates(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the successes with Wilson's 95 % intervals, and the median errors, None where half have no answer."""
    counts = {name: sum(within(row, name) for row in rows) for name in LIMITS}
    return {name: asdict(success_rate(n, len(rows))) for name, n in counts.items()} | median_errors(rows)


def median_errors(rows: Sequence[Row]) -> dict[str, float | None]:
    """Return the median errors of translation and rotation, None where half of the rows have no answer."""
    found = {}
    for part in ("translation", "rotation_deg"):
        middle = statistics.median(float("inf") if row[part] is None else row[part] for row in rows)
        found[f"median_{part}"] = None if middle == float("inf") else middle
    return found


def judgement(rows: Sequence[Row]) -> dict[str, Any]:
    """Return how well the answers judge themselves: accepted, wrong of these, right but rejected, inside their 95 % bounds."""
    pairs = [(row["converged"], within(row)) for row in rows]
    known = [row["normalized_error_squared"] for row in rows if row["converged"]]
    covered = [value for value in known if value is not None]
    return {
        "converged": sum(said for said, _ in pairs),
        "silent": sum(said and not good for said, good in pairs),
        "right_but_rejected": sum(good and not said for said, good in pairs),
        "inside_95_of_converged": [sum(value <= BOUND for value in covered), len(covered)],
    }


def cpu_seconds(rows: Sequence[Row]) -> dict[str, float]:
    times = [row["cpu_seconds"] for row in rows]
    return {"median_cpu_seconds": statistics.median(times), "slowest_cpu_seconds": max(times)}


def line(name: str, rows: Sequence[Row]) -> str:
    """Return the counts of some answers as a line of a table."""
    j, inside = judgement(rows), judgement(rows)["inside_95_of_converged"]
    return (
        f"{name:52} n {len(rows):4}  right {sum(map(within, rows)):4}  strict {sum(within(r, STRICT) for r in rows):4}"
        f"  converged {j['converged']:4}  silent {j['silent']:4}  rejected {j['right_but_rejected']:4}"
        f"  inside {inside[0]}/{inside[1]}  {cpu_seconds(rows)['median_cpu_seconds']:.2f} s"
    )


# Comparisons, and records.


def in_turn(names: Sequence[str], place: int) -> list[str]:
    """Return names in the order in which they have their turn, which moves on by one with each frame."""
    shift = place % len(names)
    return [*names[shift:], *names[:shift]]


def times_slower(rows: Sequence[Row], base: Sequence[Row], clock: str = "cpu_seconds") -> float:
    """Return how many times longer some answers took than those of ``base`` in the same turns: the median of the ratios."""
    return statistics.median(row[clock] / other[clock] for row, other in zip(rows, base, strict=True))


class RowStore:
    """A file of rows by key, each on a line ``{"key": KEY, "row": ROW}``, which lets an interrupted script resume.

    Use it as a context manager. Each row is computed once, and is on disk before the next one is.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @staticmethod
    def parse(content: bytes) -> dict[str, Any]:
        """Return the rows of all complete lines, by the JSON of their keys.

        Raises ``ValueError`` for a file of something else.
        """
        *lines, last = content.split(b"\n")
        if not b'{"key": '.startswith(last[:8]):  # a row that a kill has cut begins as all do
            raise ValueError("no file of rows")
        return {line["key"]: line["row"] for line in map(json.loads, lines)}

    def __enter__(self) -> Self:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("a+b")
        if not take_lock(self._file.fileno()):
            self._file.close()
            raise FileInUse("another process is writing to it", where=self.path)
        self._file.seek(0)
        content = self._file.read()
        self.rows = self.parse(content)
        self._file.truncate(content.rfind(b"\n") + 1)  # a kill may have cut the last line
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __contains__(self, key: list[Any]) -> bool:
        return json.dumps(key) in self.rows

    def get(self, key: list[Any], make: Callable[[], Any]) -> Any:
        """Return the row of ``key``; if the file does not hold it, compute it with ``make`` and store it."""
        text = json.dumps(key)
        if text not in self.rows:
            row = make()
            self._file.write(json.dumps({"key": text, "row": row}, allow_nan=False).encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
            self.rows[text] = row
        return self.rows[text]


def record(name: str, results: dict[str, Any], seed: int = 0, folder: Path = RESULTS) -> Path:
    """Write a summary with its provenance, rounded to five digits, print its path and return it.

    Rows of single answers do not belong in it.
    Raises ``ValueError`` if ``results`` contain values that strict JSON cannot represent.
    """
    threads, path = torch.get_num_threads(), folder / f"{name}.json"
    run = provenance(script_command(), f"one process of {threads} thread{'s' if threads > 1 else ''}")
    kept = {"benchmark": name, **to_plain(run), "seed": seed, "results": _round(results)}
    folder.mkdir(parents=True, exist_ok=True)
    write_file(path, (_in_lines(kept) + "\n").encode())
    print(path)
    if path.stat().st_size > 60_000:
        print(f"{path}: {path.stat().st_size} bytes, more than a summary should have")
    return path


def _in_lines(value: Any, indent: str = "") -> str:
    """Return a value as JSON, with each object or list on one line if it fits in 120 columns."""
    line = json.dumps(value, allow_nan=False)
    if len(indent) + len(line) <= 120 or not value or not isinstance(value, (dict, list, tuple)):
        return line
    deeper = indent + " "
    if isinstance(value, dict):
        parts = [f"{json.dumps(key)}: {_in_lines(part, deeper)}" for key, part in value.items()]
    else:
        parts = [_in_lines(part, deeper) for part in value]
    first, last = "{}" if isinstance(value, dict) else "[]"
    return f"{first}\n{deeper}" + f",\n{deeper}".join(parts) + f"\n{indent}{last}"


def _round(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.5g}")
    if isinstance(value, dict):
        return {key: _round(part) for key, part in value.items()}
    return [_round(part) for part in value] if isinstance(value, (list, tuple)) else value
