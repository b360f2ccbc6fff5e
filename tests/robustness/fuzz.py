"""Damaged files, odd options and odd arguments, drawn by hypothesis, for all commands and for the Python interface.

Every case runs in a child on a fresh copy of a folder of sound files.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import tiny
from bidnerf import SE3, Frame, Intrinsics, Localizer, Tracker, load_map, open_sequence
from bidnerf_core.localization import settings_of
from damage import (
    NUMBERS,
    TEXTS,
    Damages,
    draw_damage,
    of_array,
    of_colmap,
    of_image,
    of_json,
    of_points,
    of_tensors,
    zeros_png,
)
from harness import (
    AUTO,
    BAKED,
    NOBODY,
    QUICK,
    Check,
    Checks,
    Door,
    defects,
    files_of,
    instead,
    localize_photo,
    localizer,
    photo,
    run,
    sound_folder,
)
from scan_layouts import read_all

FolderDoor = list[str] | Callable[[Path], object]
"""An entry point: the words of a command, in which ``{}`` stands for the folder, or a function of the folder."""
SHORT = tiny.options(2)
PHOTO = [*shlex.split("localize {}/map {}/photo.png --start {}/pose.json"), *QUICK]
KNOWN = [*PHOTO, "--hfov", "40"]
FRAME = [*shlex.split("localize {}/map {}/data --perturb 0.1 5"), *QUICK]
EVALUATE = [*shlex.split("evaluate {}/map {}/data --size 0.3 --trials 1 --workers 1"), *QUICK, "--out"]
SEARCH = [*shlex.split("evaluate {}/map {}/data --protocol none --trials 1 --workers 1"), *AUTO, "--out"]
TRAIN = ["train", "{}/data", "--out", "{}/new", *SHORT]
RENDER = ["render", "{}/map", "{}/data", "--out", "{}/new"]
TRACK = ["track", "{}/map", "{}/data", "--out", "{}/new.json"]
BAKE = ["bake", "{}/map", "--data", "{}/data", *BAKED]
REPORT = ["report", "{}/results.jsonl", "--out", "{}/new"]
COMPARE = ["compare", "{}/map", "{}/map2", "{}/data", "--trials", "1", *QUICK]
COLMAP = ["train", "{}/colmap", "--out", "{}/new", *SHORT]


def frame_door(**options: Any) -> Callable[[Path], object]:
    def door(folder: Path) -> object:
        given = {name: folder / value if isinstance(value, str) else value for name, value in options.items()}
        return Frame.open(folder / "photo.png", **given)

    return door


def restore(folder: Path) -> None:
    """Restore a tracker from its stored state, and track two frames more."""
    tracker = Tracker(localizer(folder))
    tracker.restore(folder / "state")
    for timed in list(open_sequence(folder / "data"))[4:6]:
        tracker(timed.frame, timed.time)


OF_DATA: list[FolderDoor] = [
    TRAIN,
    RENDER,
    FRAME,
    [*EVALUATE, "{}/new.jsonl"],
    BAKE,
    TRACK,
    lambda folder: read_all(folder / "data"),
]
OF_MAP: list[FolderDoor] = [
    ["info", "{}/map"],
    ["info", "{}/map", "--json"],
    RENDER,
    FRAME,
    [*EVALUATE, "{}/new.jsonl"],
    BAKE,
    lambda folder: load_map(folder / "map"),
    localize_photo,
    ["train", "{}/data", "--out", "{}/map", "--resume"],
]
OF_BAKED: list[FolderDoor] = [
    ["info", "{}/map"],
    ["localize", "{}/map", "{}/data", *AUTO],
    BAKE,
    TRACK,
    lambda folder: load_map(folder / "map"),
    localize_photo,
    [*SEARCH, "{}/new.jsonl"],
]


MODEL, STATE = "colmap/sparse/0/*.bin", "state"
TARGETS: list[tuple[str, Callable[[bytes], Damages], list[FolderDoor]]] = [
    # A pattern of files in the folder, what can be wrong with them, and what reads them.
    ("data/transforms_t*.json", of_json, OF_DATA),
    ("data/images/t*/*.png", of_image, OF_DATA),
    ("data/depth/t*/*.png", of_image, OF_DATA),
    ("map/map.json", of_json, OF_MAP),
    ("map/capture-*", of_json, [["info", "{}/map"], ["info", "{}/map", "--json"], BAKE]),
    ("map/weights-*", of_tensors, OF_MAP),
    ("map/surface-*", of_tensors, OF_BAKED),
    ("map/landmarks-*", of_tensors, OF_BAKED),
    ("photo.png", of_image, [KNOWN, [*PHOTO, "--camera", "{}/camera.json"], frame_door(hfov=40.0), frame_door()]),
    (
        "photo.depth.png",
        of_image,
        [[*KNOWN, "--depth", "{}/photo.depth.png"], frame_door(hfov=40.0, depth="photo.depth.png")],
    ),
    (
        "photo.depth.npy",
        of_array,
        [[*KNOWN, "--depth", "{}/photo.depth.npy"], frame_door(hfov=40.0, depth="photo.depth.npy")],
    ),
    ("camera.json", of_json, [[*PHOTO, "--camera", "{}/camera.json"], frame_door(camera="camera.json")]),
    ("cameras.txt", of_points, [[*PHOTO, "--camera", "{}/cameras.txt"], frame_door(camera="cameras.txt")]),
    ("pose.json", of_json, [KNOWN, [*KNOWN, "--json"]]),
    (
        MODEL,
        of_colmap,
        [COLMAP, lambda folder: read_all(folder / "colmap"), [*TRAIN, "--depth-points", "{}/colmap/sparse/0"]],
    ),
    (STATE, of_tensors, [restore]),
    ("results.jsonl", of_json, [REPORT, [*SEARCH, "{}/results.jsonl"]]),
    ("results.meta.json", of_json, [REPORT, [*EVALUATE, "{}/results.jsonl"]]),
]


# Other things in place of a file.


PLACES: dict[str, Callable[[Path], object]] = {
    "no permission": lambda path: path.chmod(0),
    "a folder": partial(instead, Path.mkdir),
    "a pipe": partial(instead, os.mkfifo),
    "missing": Path.unlink,
    "link to nothing": partial(instead, lambda path: path.symlink_to("nowhere")),
    "link to itself": partial(instead, lambda path: path.symlink_to(path)),
    "link to /dev/zero": partial(instead, lambda path: path.symlink_to("/dev/zero")),
    "link to /dev/random": partial(instead, lambda path: path.symlink_to("/dev/random")),
    "4 GB of zeros": lambda path: os.truncate(path, 4 * 2**30),  # of which the disk holds nothing
    "another file": lambda path: path.write_bytes(struct.pack("<QQ", 8, 0) + b"\x7fELF" * 30),
}


# Options and arguments.

COMMANDS: list[list[str]] = [
    TRAIN,
    RENDER,
    FRAME,
    [*EVALUATE, "{}/new.jsonl"],
    BAKE,
    ["info", "{}/map"],
    COMPARE,
    KNOWN,
    REPORT,
    TRACK,
    ["backends"],
    ["demo", "--out", "{}/new", "--frames", "0"],
]
OPTIONS = """
--out --seed --split --frame --size --trials --workers --images --angle --fault --device --protocol --method
--steps --levels --log2-table-size --width --learning-rate --cells --rays --max-steps --hypotheses --start --perturb --window
--depth --depth-unit --depth-points --camera --focal --hfov --draw --json --level --overwrite --resume --background --backend
--dask --known --criterion --title --no-depth --split= --plot --help --help-all --nothing
""".split()  # noqa: SIM905
VALUES = (
    *TEXTS,
    *NUMBERS,
    "test",
    "train",
    "none",
    "auto",
    "bid",
    "0.3",
    "1",
    "2",
    "1e9",
    "99999999",
    "{}",
    "{}/map",
    "{}/data",
    "{}/photo.png",
    "{}/nowhere",
    "/dev/null",
    "/",
    "demo:blobs",
    "demo:nothing",
    "x\x1b[2Jy",
    "\udcff",
    "0.1:5",
    "white",
)


@st.composite
def odd_words(draw: st.DrawFn) -> list[str]:
    """Draw a command with options that are unknown, out of range, contradictory, or not even valid text."""
    words, value = list(draw(st.sampled_from(COMMANDS))), st.sampled_from(VALUES)
    for how in draw(st.lists(st.sampled_from(["add", "add", "add", "replace", "leave out"]), min_size=1, max_size=4)):
        place = draw(st.integers(1, len(words)))
        if how == "add":
            words += [draw(st.sampled_from(OPTIONS)), *draw(st.lists(value, max_size=3))]
        elif place < len(words):
            words[place : place + 1] = [draw(value)] if how == "replace" else []
    return words


ODD_NUMBERS: tuple[Any, ...] = (
    0,
    -1,
    1.5,
    float("nan"),
    float("inf"),
    1e308,
    10**400,
    2**63,
    "1",
    None,
    True,
    [],
    np.float32(24),
    24,
)
ODD_SHAPES = (
    (24, 24, 3),
    (24, 24),
    (0, 0, 3),
    (24, 24, 5),
    (3, 24, 24),
    (),
    (24,),
    (1, 1, 3),
    (24, 24, 4),
    (24, 24, 0),
)
ODD_LENSES: tuple[Any, ...] = ((), (1, 2), (float("nan"),) * 4, (1e9,) * 5, (-1e6,) * 14, None, "k1")


@st.composite
def odd_call(draw: st.DrawFn) -> tuple[str, Callable[[Path], object]]:
    """Draw the name and the call of a public function with unusable arguments."""

    def one_of(*values: Any) -> Any:
        return draw(st.sampled_from(values))

    n = [one_of(*ODD_NUMBERS) for _ in range(6)]
    kind = one_of("u1", "u2", "i4", "f2", "f4", "f8", "c8", "?", "O", "U1")
    array = np.full(one_of(*ODD_SHAPES), one_of(0, 1, 0.5, 255, np.nan, -1), "f8").astype(kind, casting="unsafe")
    pixels: Any = one_of(array, array, array, None, "photo.png", [[1, 2], [3]], torch.zeros(24, 24, 3))
    numbers = torch.full((24, 24, 3), float("nan")), torch.zeros((24, 24, 3), dtype=torch.int64)
    tensor: Any = one_of(pixels, *numbers)
    poses = np.zeros((4, 4)), np.full((4, 4), np.nan), np.eye(4) * 1e308, torch.eye(3), SE3.identity()
    start: Any = one_of(n, "x", [[1] * 4] * 4, *poses)
    lens, zeros = one_of(*ODD_LENSES), np.zeros((24, 24, 3), "u1")
    bid = partial(settings_of, "bid", {"max_steps": 2, "rays": 32})
    calls: dict[str, Callable[[Path], object]] = {
        "Intrinsics": lambda folder: Intrinsics(*n, lens),
        "from_hfov": lambda folder: Intrinsics.from_hfov(*n[:3]),
        "from_numpy": lambda folder: Frame.from_numpy(pixels, tiny.CAMERA),
        "from_numpy depth": lambda folder: Frame.from_numpy(zeros, tiny.CAMERA, depth=pixels, depth_unit=n[0]),
        "Frame": lambda folder: localize_photo(folder, Frame("x", tensor, tiny.CAMERA)),
        "Localizer": lambda folder: Localizer(*n[:3]),
        "start": lambda folder: Localizer(load_map(folder / "map"), "bid", bid(), warm_up=False)(photo(folder), start),
        "seed": lambda folder: localize_photo(folder, seed=n[0]),
        "Frame.open": lambda folder: Frame.open(folder / "photo.png", hfov=n[0], largest=n[1]),
    }
    name = one_of(*calls)
    return name, calls[name]


# Cases.


@dataclass(frozen=True)
class Case:
    """What is wrong with a folder, and the entry point that reads it."""

    kind: str
    door: FolderDoor
    damage: Callable[[Path], object] = lambda folder: None
    nobody: bool = False  # run as a user without privileges, since root ignores permissions


@st.composite
def cases(draw: st.DrawFn, sound: Path, only: str | None) -> Case:
    kind = "content" if only else draw(st.sampled_from(["options"] * 2 + ["Python", "place"] + ["content"] * 6))
    if kind == "options":
        return Case("options", draw(odd_words()))
    if kind == "Python":
        name, call = draw(odd_call())
        return Case(f"Python: {name}", call)
    pattern, damages, doors = draw(st.sampled_from([target for target in TARGETS if only in (None, target[0])]))
    inside = draw(st.sampled_from(sorted(sound.glob(pattern)))).relative_to(sound)
    door = draw(st.sampled_from(doors))
    if kind == "place":
        name = draw(st.sampled_from(sorted(PLACES)))
        return Case(f"{inside}: {name}", door, lambda folder: PLACES[name](folder / inside), name == "no permission")
    name, content = draw(draw_damage(damages((sound / inside).read_bytes())))
    return Case(f"{inside}: {name}", door, lambda folder: (folder / inside).write_bytes(content))


def wrong_with(case: Case, folder: Path) -> list[str]:
    """Run a case in ``folder``, and return what is wrong with its end."""
    case.damage(folder)
    before = files_of(folder)
    if case.nobody and os.geteuid() == 0:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, NOBODY, NOBODY, follow_symlinks=False)
    words = [word.replace("{}", str(folder)) for word in case.door] if isinstance(case.door, list) else None
    door: Door = words or partial(case.door, folder)  # type: ignore[arg-type]
    found = run(door, folder.with_suffix(".log"), nobody=case.nobody, before=partial(os.chdir, folder))
    return defects(found, folder if words else None, before)


def checks(work: Path, count: int, minutes: float = 10.0, only: str | None = None) -> Sequence[Check]:
    """Return the checks of up to ``count`` cases, none of which begins when the time is over.

    ``only``: the pattern of one target, of which all cases are damaged content then.
    """
    sound, found = sound_folder(work / "sound"), list[Check]()
    until = time.monotonic() + 60 * minutes

    @settings(
        max_examples=count,
        phases=[Phase.generate],
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(case=cases(sound, only))
    def run_case(case: Case) -> None:
        if time.monotonic() < until:
            folder = Path(shutil.copytree(sound, work / f"case{len(found)}", symlinks=True))
            wrong = tuple(text.replace(str(folder), "{}") for text in wrong_with(case, folder))
            found.append(Check(f"{case.kind}: {case.door if isinstance(case.door, list) else 'call'}", wrong))
            shutil.rmtree(folder, ignore_errors=True)

    run_case()
    return found


def large_inputs(work: Path) -> Checks:
    """Check that a small file of many pixels, and a description of many cameras, do not take gigabytes."""
    folder = sound_folder(work / "sound")
    (folder / "large.png").write_bytes(zeros_png(9900, 6, 4))  # 98 megapixels, RGBA
    path = folder / "map" / "map.json"
    plain = json.loads(path.read_text())
    cameras = [plain["cameras"][n % len(plain["cameras"])] | {"name": f"{n:06}"} for n in range(200_000)]
    path.write_text(json.dumps(plain | {"cameras": cameras}))
    read = partial(Frame.open, folder / "large.png", hfov=41.0)
    cases: dict[str, tuple[Door, int]] = {
        "98 megapixels, largest=640": (partial(read, largest=640), 5 * 2**29),
        "98 megapixels": (read, 3 * 2**30),
        "info, 200,000 cameras": (["info", folder / "map"], 2**30 + path.stat().st_size),
        "localize, 200,000 cameras": (
            ["localize", folder / "map", folder / "photo.png", "--hfov", "40", *AUTO],
            2**30 + path.stat().st_size,
        ),
    }
    for name, (door, memory) in cases.items():
        yield Check(name, tuple(defects(run(door, work / "case", memory=memory))))
