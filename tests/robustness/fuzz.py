"""Damaged files, odd options and odd arguments, drawn at random, for all commands and for the Python interface.

    python tests/robustness/fuzz.py [--count 10000] [--minutes 10] [--seed 0] [--only NUMBER ...]

Every case is drawn from its own seed and runs in a child on a fresh copy of a folder of sound files. ``--only`` repeats cases.
"""

from __future__ import annotations

import argparse
import os
import shutil
import stat
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from bidnerf_core import SE3, Frame, Intrinsics, Localizer, load_map
from bidnerf_core.localization import settings_of
from damage import ARRAYS, BYTES, IMAGES, JSON, NUMBERS, POINTS, TENSORS, TEXTS, Damage, counts
from harness import (
    AUTO,
    BAKED,
    CAMERA,
    QUICK,
    SMALL_FIELD,
    Check,
    Outcome,
    defects,
    files_of,
    localized,
    photo,
    run,
    sound_folder,
    views_of,
)

FolderDoor = list[str] | Callable[[Path], object]
"""An entry point: the words of a command, in which ``{}`` stands for the folder, or a function of the folder."""
PHOTO = ["localize", "{}/map", "{}/photo.png", *QUICK, "--start", "{}/pose.json"]
KNOWN = [*PHOTO, "--hfov", "40"]
FRAME = ["localize", "{}/map", "{}/data", "--perturb", "0.1", "5", *QUICK]
EVALUATE = [
    "evaluate",
    "{}/map",
    "{}/data",
    "--size",
    "0.3",
    "--trials",
    "1",
    "--workers",
    "1",
    *QUICK,
    "--out",
]
SEARCH = [
    "evaluate",
    "{}/map",
    "{}/data",
    "--protocol",
    "none",
    "--trials",
    "1",
    "--workers",
    "1",
    *AUTO,
    "--out",
]
TRAIN = ["train", "{}/data", "--out", "{}/new", *SMALL_FIELD, "--steps", "2", "--no-bake"]
RENDER = ["render", "{}/map", "{}/data", "--out", "{}/new"]
TRACK = ["track", "{}/map", "{}/data", "--out", "{}/new.json"]
BAKE = ["bake", "{}/map", "--data", "{}/data", *BAKED]
REPORT = ["report", "{}/results.jsonl", "--out", "{}/new"]
COMPARE = ["compare", "{}/map", "{}/map2", "{}/data", "--trials", "1", *QUICK]
COLMAP = ["train", "{}/colmap", "--out", "{}/new", *SMALL_FIELD, "--steps", "2", "--no-bake"]


def frame_door(**options: Any) -> Callable[[Path], object]:
    def door(folder: Path) -> object:
        given = {name: folder / value if isinstance(value, str) else value for name, value in options.items()}
        return Frame.open(folder / "photo.png", **given)

    return door


def map_door(folder: Path) -> object:
    return load_map(folder / "map")


def data_door(folder: Path) -> object:
    return views_of(folder / "data")


OF_DATA: list[FolderDoor] = [TRAIN, RENDER, FRAME, [*EVALUATE, "{}/new.jsonl"], BAKE, TRACK, data_door]
OF_MAP: list[FolderDoor] = [
    ["info", "{}/map"], ["info", "{}/map", "--json"], RENDER, FRAME, [*EVALUATE, "{}/new.jsonl"], BAKE, map_door, localized,
    ["train", "{}/data", "--out", "{}/map", "--resume"],
]  # fmt: skip
OF_BAKED: list[FolderDoor] = [
    ["info", "{}/map"], ["localize", "{}/map", "{}/data", *AUTO], BAKE, TRACK, map_door, localized, [*SEARCH, "{}/new.jsonl"],
]  # fmt: skip


@dataclass(frozen=True)
class Target:
    """A file that can be damaged."""

    file: str  # in the folder, as a pattern
    damages: dict[str, Damage] | Callable[[bytes], dict[str, Damage]]
    doors: list[FolderDoor]

    def damages_of(self, content: bytes) -> dict[str, Damage]:
        return self.damages(content) if callable(self.damages) else self.damages


TARGETS = [
    Target("data/transforms_t*.json", JSON, OF_DATA),
    Target("data/images/t*/*.png", IMAGES, OF_DATA),
    Target("data/depth/t*/*.png", IMAGES, OF_DATA),
    Target("map/map.json", JSON, OF_MAP),
    Target("map/capture-*", JSON, [["info", "{}/map"], ["info", "{}/map", "--json"], BAKE]),
    Target("map/weights-*", TENSORS, OF_MAP),
    Target("map/surface-*", TENSORS, OF_BAKED),
    Target("map/landmarks-*", TENSORS, OF_BAKED),
    Target("photo.png", IMAGES, [KNOWN, [*PHOTO, "--camera", "{}/camera.json"], frame_door(hfov=40.0), frame_door()]),
    Target("photo.depth.png", IMAGES, [[*KNOWN, "--depth", "{}/photo.depth.png"], frame_door(hfov=40.0, depth="photo.depth.png")]),
    Target("photo.depth.npy", ARRAYS, [[*KNOWN, "--depth", "{}/photo.depth.npy"], frame_door(hfov=40.0, depth="photo.depth.npy")]),
    Target("camera.json", JSON, [[*PHOTO, "--camera", "{}/camera.json"], frame_door(camera="camera.json")]),
    Target("cameras.txt", POINTS, [[*PHOTO, "--camera", "{}/cameras.txt"], frame_door(camera="cameras.txt")]),
    Target("pose.json", JSON, [KNOWN, [*KNOWN, "--json"]]),
    Target("points.txt", POINTS, [[*KNOWN, "--depth-points", "{}/points.txt"]]),
    Target("points.npy", ARRAYS, [[*KNOWN, "--depth-points", "{}/points.npy"]]),
    Target("points.npz", ARRAYS, [[*KNOWN, "--depth-points", "{}/points.npz"]]),
    Target("colmap/sparse/0/*.bin", lambda content: BYTES | counts(content), [COLMAP, lambda folder: views_of(folder / "colmap")]),
    Target("results.jsonl", JSON, [REPORT, [*SEARCH, "{}/results.jsonl"]]),
    Target("results.meta.json", JSON, [REPORT, [*EVALUATE, "{}/results.jsonl"]]),
]  # fmt: skip


# Other things in place of a file.


def instead(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def place(path: Path) -> None:
        path.unlink()
        make(path)

    return place


PLACES: dict[str, Callable[[Path], object]] = {
    "no permission": lambda path: path.chmod(0),
    "a folder": instead(Path.mkdir),
    "a pipe": instead(os.mkfifo),
    "missing": Path.unlink,
    "link to nothing": instead(lambda path: path.symlink_to("nowhere")),
    "link to itself": instead(lambda path: path.symlink_to(path)),
    "link to /dev/zero": instead(lambda path: path.symlink_to("/dev/zero")),
    "link to /dev/random": instead(lambda path: path.symlink_to("/dev/random")),
    "4 GB of zeros": lambda path: os.truncate(path, 4 * 2**30),  # of which the disk holds nothing
    "another file": lambda path: path.write_bytes(struct.pack("<QQ", 8, 0) + b"\x7fELF" * 30),
}


# Options and arguments.

COMMANDS: list[list[str]] = [
    TRAIN, RENDER, FRAME, [*EVALUATE, "{}/new.jsonl"], BAKE, ["info", "{}/map"], COMPARE, KNOWN, REPORT, TRACK, ["backends"],
    ["demo", "--out", "{}/new", "--frames", "0"],
]  # fmt: skip
OPTIONS = """
--out --seed --split --frame --size --trials --workers --shards --shard --images --angle --fault --device --protocol --method
--steps --levels --log2-table-size --width --learning-rate --cells --rays --max-steps --hypotheses --start --perturb --window
--depth --depth-unit --depth-points --camera --focal --hfov --draw --json --level --overwrite --resume --background --backend
--config --dask --no-start --criterion --title --no-depth --split= --plot --video --help --help-all --nothing
""".split()  # noqa: SIM905
VALUES = (
    *TEXTS, *NUMBERS, "test", "train", "none", "auto", "bid", "0.3", "1", "2", "1e9", "99999999", "{}", "{}/map", "{}/data",
    "{}/photo.png", "{}/nowhere", "/dev/null", "/", "demo:blobs", "demo:nothing", "x\x1b[2Jy", "\udcff", "0.1:5", "white",
)  # fmt: skip


def odd_words(chance: Random) -> list[str]:
    """Return a command with options that are unknown, out of range, contradictory, or not even valid text."""
    words = list(chance.choice(COMMANDS))
    for _ in range(chance.choice((1, 1, 2, 4))):
        place, how = chance.randrange(1, len(words) + 1), chance.random()
        if how < 0.6:
            count = chance.choice((0, 1, 1, 1, 2, 3))
            words += [chance.choice(OPTIONS), *(chance.choice(VALUES) for _ in range(count))]
        elif how < 0.8 and place < len(words):
            words[place] = chance.choice(VALUES)
        elif place < len(words):
            del words[place]
    return words


ODD_NUMBERS: tuple[Any, ...] = (
    0, -1, 1.5, float("nan"), float("inf"), 1e308, 10**400, 2**63, "1", None, True, [], np.float32(24), 24,
)  # fmt: skip
ODD_SHAPES = (
    (24, 24, 3), (24, 24), (0, 0, 3), (24, 24, 5), (3, 24, 24), (), (24,), (1, 1, 3), (24, 24, 4), (24, 24, 0),
)  # fmt: skip
ODD_LENSES: tuple[Any, ...] = ((), (1, 2), (float("nan"),) * 4, (1e9,) * 5, (-1e6,) * 14, None, "k1")


def odd_call(chance: Random) -> tuple[str, Callable[[Path], object]]:
    """Return the name and the call of a public function with unusable arguments."""
    n = [chance.choice(ODD_NUMBERS) for _ in range(6)]
    kind, value = (
        chance.choice(("u1", "u2", "i4", "f2", "f4", "f8", "c8", "?", "O", "U1")),
        (0, 1, 0.5, 255, np.nan, -1),
    )
    pixels: Any = np.full(chance.choice(ODD_SHAPES), chance.choice(value), "f8").astype(
        kind, casting="unsafe"
    )
    pixels = chance.choice((pixels, pixels, pixels, None, "photo.png", [[1, 2], [3]], torch.zeros(24, 24, 3)))
    tensor: Any = chance.choice(
        (pixels, torch.full((24, 24, 3), float("nan")), torch.zeros((24, 24, 3), dtype=torch.int64))
    )
    start: Any = chance.choice(
        (
            n,
            np.zeros((4, 4)),
            np.full((4, 4), np.nan),
            np.eye(4) * 1e308,
            "x",
            [[1] * 4] * 4,
            torch.eye(3),
            SE3.identity(),
        )
    )
    lens, zeros = chance.choice(ODD_LENSES), np.zeros((24, 24, 3), "u1")
    bid = partial(settings_of, "bid", {"max_steps": 2, "rays": 32})
    calls: dict[str, Callable[[Path], object]] = {
        "Intrinsics": lambda folder: Intrinsics(*n, lens),
        "from_hfov": lambda folder: Intrinsics.from_hfov(*n[:3]),
        "from_numpy": lambda folder: Frame.from_numpy(pixels, CAMERA),
        "from_numpy depth": lambda folder: Frame.from_numpy(zeros, CAMERA, depth=pixels, depth_unit=n[0]),
        "Frame": lambda folder: localized(folder, Frame("x", tensor, CAMERA)),
        "Localizer": lambda folder: Localizer(*n[:3]),
        "start": lambda folder: Localizer(load_map(folder / "map"), "bid", bid(), warm_up=False)(photo(folder), start),
        "seed": lambda folder: localized(folder, seed=n[0]),
        "Frame.open": lambda folder: Frame.open(folder / "photo.png", hfov=n[0], largest=n[1]),
    }  # fmt: skip
    name = chance.choice(list(calls))
    return name, calls[name]


# Cases.


@dataclass(frozen=True)
class Case:
    """A damaged folder, and the entry point that reads it."""

    kind: str
    door: FolderDoor
    nobody: bool = False  # run as a user without privileges, since root ignores permissions


def draw_case(chance: Random, sound: Path, folder: Path) -> Case:
    """Make a copy ``folder`` of the sound files, damage it, and return the case."""
    shutil.copytree(sound, folder, symlinks=True)
    kind = chance.random()
    if kind < 0.2:
        return Case("options", odd_words(chance))
    if kind < 0.3:
        name, call = odd_call(chance)
        return Case(f"Python: {name}", call)
    target = chance.choice(TARGETS)
    file = chance.choice(sorted(folder.glob(target.file)))
    door = chance.choice(target.doors)
    if kind < 0.4:
        name = chance.choice(list(PLACES))
        PLACES[name](file)
    else:
        content = file.read_bytes()
        damages = target.damages_of(content)
        name = chance.choice(list(damages))
        file.write_bytes(damages[name](chance, content))
    return Case(f"{target.file}: {name}", door, name == "no permission")


def run_case(case: Case, folder: Path) -> tuple[Outcome, list[str]]:
    """Run a case; return how it ended, and what is wrong with that."""
    before = files_of(folder)
    if case.nobody and os.geteuid() == 0:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, 65534, 65534, follow_symlinks=False)
    is_command = isinstance(case.door, list)
    door = (
        [w.replace("{}", str(folder)) for w in case.door]
        if isinstance(case.door, list)
        else partial(case.door, folder)
    )
    found = run(door, folder.with_suffix(".log"), nobody=case.nobody, before=partial(os.chdir, folder))  # fmt: skip
    return found, defects(found, folder if is_command else None, before)


def remove(folder: Path) -> None:
    for path in folder.rglob("*"):
        if not path.is_symlink() and not stat.S_IMODE(path.stat().st_mode) & stat.S_IWUSR:
            path.chmod(0o755)
    shutil.rmtree(folder, ignore_errors=True)


def checks(
    work: Path, numbers: Iterator[int], seed: int = 0, minutes: float = 10.0
) -> Iterator[tuple[Check, Outcome]]:
    """Yield each case with its outcome, until the time is over."""
    work.chmod(0o755)
    sound = work / "sound"
    sound.mkdir()
    sound_folder(sound)
    until = time.monotonic() + 60 * minutes
    for number in numbers:
        if time.monotonic() > until:
            return
        folder = work / f"case{number}"
        case = draw_case(Random(f"{seed}/{number}"), sound, folder)
        outcome, wrong = run_case(case, folder)
        said = tuple(text.replace(str(folder), "{}") for text in wrong)
        yield (
            Check(f"{number}: {case.kind}: {case.door if isinstance(case.door, list) else 'call'}", said),
            outcome,
        )
        remove(folder)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=10.0, help="no case begins after this time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="*", help="run these cases, and print all that they say")
    given = parser.parse_args()
    endings, wrong = Counter[str](), 0
    with TemporaryDirectory() as place:
        for check, outcome in checks(
            Path(place), iter(given.only or range(given.count)), given.seed, given.minutes
        ):
            endings[outcome.ending] += 1
            wrong += bool(check.wrong)
            if check.wrong or given.only:
                print(check.name, *check.wrong, *([outcome] if given.only else []), sep="\n  ", flush=True)
    print(f"{endings.total()} cases: {dict(endings.most_common())}; {wrong} with defects")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
