"""The cases of ``fuzz.py``: a folder of sound files, the ways to damage it, and the entry points that read damaged files."""

from __future__ import annotations

import json
import os
import shutil
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, TypeAlias

import imageio.v3 as iio
import numpy as np
import torch
from malformed import ARRAYS, IMAGES, JSON, NUMBERS, POINTS, TENSORS, TEXTS, Damage

from bidnerf_core import Frame, Intrinsics, Localizer, load_map
from bidnerf_core.cli import main
from bidnerf_core.datasets import open_dataset, write_transforms
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization import settings_of
from bidnerf_core.scenes.closed_form import views as seen_from
from bidnerf_core.scenes.demo import demo_object
from bidnerf_core.scenes.trajectories import orbit

SMALL_CAMERA = Intrinsics(32.0, 32.0, 12.0, 12.0, 24, 24)
SMALL_FIELD = [
    "--levels",
    "3",
    "--log2-table-size",
    "9",
    "--base-resolution",
    "4",
    "--finest-resolution",
    "16",
    "--width",
    "16",
    "--geometry-features",
    "3",
    "--grid-resolution",
    "16",
    "--coarse-levels",
    "1",
    "--samples-per-step",
    "2048",
    "--rays-at-most",
    "256",
    "--prune-from",
    "4",
    "--prune-every",
    "4",
]
QUICK = ["--method", "bid", "--max-steps", "2", "--rays", "32"]
AUTO = ["--points", "100", "--hypotheses", "8", "--rounds", "1", "--refine-rays", "64"]
BAKED = ["--cells", "2000"]

Words: TypeAlias = list[str]
PythonDoor: TypeAlias = Callable[[Path], object]
Door: TypeAlias = Words | PythonDoor
"""An entry point: the words of a command, in which ``{}`` stands for the folder, or a function of the folder."""


# A folder of sound files.


def sound_folder(folder: Path) -> None:
    """Write a dataset, a map of it with surface and landmarks, photos with depth, and every other kind of input."""
    scene = demo_object()
    train, test = (
        seen_from(scene, SMALL_CAMERA, orbit(3.5, count, seed=seed)) for seed, count in ((0, 6), (1, 2))
    )
    write_transforms(folder / "data", {"train": train, "test": test}, scene.bounds.background)
    _run("train", folder / "data", "--out", folder / "map", *SMALL_FIELD, "--steps", "6", "--no-bake")
    _run("bake", folder / "map", "--data", folder / "data", *BAKED)
    pose = test[0].T_ref_camera.matrix().tolist()
    (folder / "pose.json").write_text(json.dumps({"T_world_camera": pose}))
    (folder / "camera.json").write_text(
        json.dumps({"fl_x": 32, "fl_y": 32, "cx": 12, "cy": 12, "w": 24, "h": 24, "k1": 0.01})
    )
    (folder / "cameras.txt").write_text("# camera\n1 OPENCV 24 24 32 32 12 12 0.01 0 0 0\n")
    (folder / "points.txt").write_text("0.1 0.1 3\n-0.1 0.1 3\n0.1 -0.1 3.1\n")
    np.save(folder / "points.npy", np.array([[0.1, 0.1, 3.0], [-0.1, 0.1, 3.0]]))
    np.savez(folder / "points.npz", points=np.array([[0.1, 0.1, 3.0]]), T_camera_sensor=np.eye(4))
    iio.imwrite(folder / "photo.png", (test[0].frame.rgb * 255).byte().numpy())
    depth = test[0].frame.depth
    assert depth is not None
    iio.imwrite(folder / "photo.depth.png", (depth * 1000).numpy().astype(np.uint16))
    np.save(folder / "photo.depth.npy", depth.numpy())
    words = ("--protocol", "none", "--trials", "1", "--workers", "1", *AUTO)
    _run("evaluate", folder / "map", folder / "data", "--out", folder / "results.jsonl", *words)
    os.chmod(folder, 0o755)


def _run(*words: object) -> None:
    if main([str(word) for word in words]) != 0:
        raise SystemExit(f"the sound command failed: {' '.join(map(str, words))}")


# Entry points.


def _frame(photo: str = "photo.png", **options: Any) -> PythonDoor:
    def door(folder: Path) -> object:
        given = {name: folder / value if isinstance(value, str) else value for name, value in options.items()}
        return Frame.open(folder / photo, **given)

    return door


def _dataset(folder: Path) -> object:
    dataset = open_dataset(folder / "data")
    return [dataset.views(split) for split in dataset.splits]


def _localizer(folder: Path) -> object:
    stored = load_map(folder / "map")
    view = seen_from(demo_object(), SMALL_CAMERA, orbit(3.5, 1, seed=1))[0]
    config = settings_of("auto", {"points": 100, "hypotheses": 8, "rounds": 1, "refine_rays": 64})
    return Localizer(stored, "auto", config)(view.frame)


def _map(folder: Path) -> object:
    return load_map(folder / "map")


PHOTO = ["localize", "{}/map", "{}/photo.png", *QUICK, "--start", "{}/pose.json"]
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
TRAIN = ["train", "{}/data", "--out", "{}/new", *SMALL_FIELD, "--steps", "2", "--no-bake"]
RENDER = ["render", "{}/map", "{}/data", "--out", "{}/new"]
BAKE = ["bake", "{}/map", "--data", "{}/data", *BAKED]
COMPARE = ["compare", "{}/map", "{}/map2", "{}/data", "--trials", "1", *QUICK]
OF_DATA: list[Door] = [TRAIN, RENDER, FRAME, [*EVALUATE, "{}/new.jsonl"], BAKE, _dataset]
OF_MAP: list[Door] = [
    ["info", "{}/map"], ["info", "{}/map", "--json"], RENDER, FRAME, [*EVALUATE, "{}/new.jsonl"], BAKE, _map, _localizer,
    ["train", "{}/data", "--out", "{}/map", "--resume"],
]  # fmt: skip
OF_BAKED: list[Door] = [
    ["info", "{}/map"], ["localize", "{}/map", "{}/data", *AUTO], BAKE, _map, _localizer,
    ["evaluate", "{}/map", "{}/data", "--protocol", "none", "--trials", "1", "--workers", "1", *AUTO, "--out", "{}/new.jsonl"],
]  # fmt: skip
OF_PHOTO: list[Door] = [
    [*PHOTO, "--hfov", "40"],
    [*PHOTO, "--camera", "{}/camera.json"],
    _frame(hfov=40.0),
    _frame(),
]


def _with(*words: str) -> list[Door]:
    return [[*PHOTO, "--hfov", "40", *words]]


@dataclass(frozen=True)
class Target:
    """A file that can be damaged."""

    file: str  # in the folder, as a pattern
    damages: dict[str, Damage]
    doors: list[Door]


TARGETS = [
    Target("data/transforms_t*.json", JSON, OF_DATA),
    Target("data/images/t*/*.png", IMAGES, OF_DATA),
    Target("data/depth/t*/*.png", IMAGES, OF_DATA),
    Target("map/map.json", JSON, OF_MAP),
    Target("map/weights-*", TENSORS, OF_MAP),
    Target("map/surface-*", TENSORS, OF_BAKED),
    Target("map/landmarks-*", TENSORS, OF_BAKED),
    Target("photo.png", IMAGES, OF_PHOTO),
    Target("photo.depth.png", IMAGES, [*_with("--depth", "{}/photo.depth.png"), _frame(hfov=40.0, depth="photo.depth.png")]),
    Target("photo.depth.npy", ARRAYS, [*_with("--depth", "{}/photo.depth.npy"), _frame(hfov=40.0, depth="photo.depth.npy")]),
    Target("camera.json", JSON, [[*PHOTO, "--camera", "{}/camera.json"], _frame(camera="camera.json")]),
    Target("cameras.txt", POINTS, [[*PHOTO, "--camera", "{}/cameras.txt"], _frame(camera="cameras.txt")]),
    Target("pose.json", JSON, [*_with(), [*_with()[0], "--json"]]),
    Target("points.txt", POINTS, _with("--depth-points", "{}/points.txt")),
    Target("points.npy", ARRAYS, _with("--depth-points", "{}/points.npy")),
    Target("points.npz", ARRAYS, _with("--depth-points", "{}/points.npz")),
    Target("results.jsonl", JSON, [["report", "{}/results.jsonl", "--out", "{}/new"],
                                   ["evaluate", "{}/map", "{}/data", "--protocol", "none", "--trials", "1", "--workers", "1",
                                    *AUTO, "--out", "{}/results.jsonl"]]),
    Target("results.meta.json", JSON, [["report", "{}/results.jsonl", "--out", "{}/new"],
                                       [*EVALUATE, "{}/results.jsonl"]]),
]  # fmt: skip


# Other things in place of a file.


def no_permission(path: Path) -> None:
    path.chmod(0)


def folder_there(path: Path) -> None:
    path.unlink()
    path.mkdir()


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def nothing(path: Path) -> None:
    path.unlink()


def link(to: str) -> Callable[[Path], None]:
    def place(path: Path) -> None:
        path.unlink()
        path.symlink_to(path if to == "itself" else to)

    return place


def hollow(path: Path) -> None:
    """Extend the file to 4 GB without occupying disk space."""
    os.truncate(path, 4 * 2**30)


def other_file(path: Path) -> None:
    path.write_bytes(struct.pack("<QQ", 8, 0) + b"\x7fELF" * 30)


PLACES: dict[str, Callable[[Path], None]] = {
    "no permission": no_permission,
    "a folder": folder_there,
    "a pipe": pipe,
    "missing": nothing,
    "link to nothing": link("nowhere"),
    "link to itself": link("itself"),
    "link to /dev/zero": link("/dev/zero"),
    "4 GB of zeros": hollow,
    "another file": other_file,
}


# Options.

COMMANDS: list[Words] = [
    TRAIN, RENDER, FRAME, [*EVALUATE, "{}/new.jsonl"], BAKE, ["info", "{}/map"], COMPARE, [*PHOTO, "--hfov", "40"],
    ["report", "{}/results.jsonl", "--out", "{}/new"], ["backends"], ["demo", "--out", "{}/new", "--frames", "0"],
]  # fmt: skip
OPTIONS = [
    "--out",
    "--seed",
    "--split",
    "--frame",
    "--size",
    "--trials",
    "--workers",
    "--shards",
    "--shard",
    "--images",
    "--angle",
    "--fault",
    "--device",
    "--protocol",
    "--method",
    "--steps",
    "--levels",
    "--log2-table-size",
    "--width",
    "--learning-rate",
    "--cells",
    "--rays",
    "--max-steps",
    "--hypotheses",
    "--start",
    "--perturb",
    "--window",
    "--depth",
    "--depth-unit",
    "--depth-points",
    "--camera",
    "--focal",
    "--hfov",
    "--draw",
    "--json",
    "--level",
    "--overwrite",
    "--resume",
    "--background",
    "--backend",
    "--config",
    "--dask",
    "--no-start",
    "--criterion",
    "--title",
    "--no-depth",
    "--split=",
    "--help",
    "--help-all",
    "--nothing",
]
VALUES = (*TEXTS, *NUMBERS, "test", "train", "none", "auto", "bid", "0.3", "1", "2", "1e9", "99999999", "{}", "{}/map", "{}/data",
          "{}/photo.png", "{}/nowhere", "/dev/null", "/", "demo:blobs", "demo:nothing", "x\x1b[2Jy", "\udcff", "0.1:5", "white")  # fmt: skip


def odd_words(chance: Random) -> Words:
    """Return a command with options that are unknown, out of range, contradictory, or not even valid text."""
    words = list(chance.choice(COMMANDS))
    for _ in range(chance.choice((1, 1, 2, 4))):
        place = chance.randrange(1, len(words) + 1)
        how = chance.random()
        if how < 0.6:
            count = chance.choice((0, 1, 1, 1, 2, 3))
            words += [chance.choice(OPTIONS), *(chance.choice(VALUES) for _ in range(count))]
        elif how < 0.8 and place < len(words):
            words[place] = chance.choice(VALUES)
        elif place < len(words):
            del words[place]
    return words


# The Python interface: unsuitable values in place of arrays and numbers.


def odd_call(chance: Random) -> tuple[str, PythonDoor]:
    """Return the name and the call of a public function with unusable arguments."""
    numbers: list[Any] = [
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
    ]
    drawn = [chance.choice(numbers) for _ in range(6)]
    shape = chance.choice(
        (
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
    )
    kind = chance.choice(("u1", "u2", "i4", "f2", "f4", "f8", "c8", "?", "O", "U1"))
    pixels: Any = np.full(shape, chance.choice((0, 1, 0.5, 255, np.nan, -1)), dtype="f8").astype(
        kind, casting="unsafe"
    )
    pixels = chance.choice((pixels, pixels, pixels, None, "photo.png", [[1, 2], [3]], torch.zeros(24, 24, 3)))
    start = chance.choice(
        (
            drawn,
            np.zeros((4, 4)),
            np.full((4, 4), np.nan),
            np.eye(4) * 1e308,
            "x",
            [[1] * 4] * 4,
            torch.eye(3),
            SE3.identity(),
        )
    )
    name = chance.choice(
        ("Intrinsics", "from_hfov", "from_numpy", "from_numpy depth", "Localizer", "start", "Frame.open")
    )
    calls: dict[str, PythonDoor] = {
        "Intrinsics": lambda folder: Intrinsics(
            *drawn, chance.choice(((), (1, 2), (float("nan"),) * 4, (1e9,) * 5, None, "k1"))
        ),
        "from_hfov": lambda folder: Intrinsics.from_hfov(drawn[0], drawn[1], drawn[2]),
        "from_numpy": lambda folder: Frame.from_numpy(pixels, SMALL_CAMERA),
        "from_numpy depth": lambda folder: Frame.from_numpy(
            np.zeros((24, 24, 3), "u1"), SMALL_CAMERA, depth=pixels, depth_unit=drawn[0]
        ),
        "Localizer": lambda folder: Localizer(drawn[0], drawn[1], drawn[2]),
        "start": lambda folder: Localizer(
            load_map(folder / "map"), "bid", settings_of("bid", {"max_steps": 2, "rays": 32}), warm_up=False
        )(_photo(folder), start),
        "Frame.open": lambda folder: Frame.open(folder / "photo.png", hfov=drawn[0], largest=drawn[1]),
    }
    return name, calls[name]


def _photo(folder: Path) -> Frame:
    return Frame.open(folder / "photo.png", hfov=40.0)


# Cases.


@dataclass(frozen=True)
class Case:
    """A damaged folder, and the entry point that reads it."""

    kind: str
    door: Door
    words: str  # the command, or the name of the function
    as_user: bool = False  # whether to run as another user, since root ignores permissions


def draw_case(chance: Random, sound: Path, folder: Path) -> Case:
    """Make a copy ``folder`` of the sound files, damage it, and return the case."""
    shutil.copytree(sound, folder, symlinks=True)
    kind = chance.random()
    if kind < 0.2:
        words = odd_words(chance)
        return Case("options", filled(words, folder), " ".join(words))
    if kind < 0.3:
        name, call = odd_call(chance)
        return Case(f"Python: {name}", call, name)
    target = chance.choice(TARGETS)
    file = chance.choice(sorted(folder.glob(target.file)))
    door = chance.choice(target.doors)
    if kind < 0.4:
        name = chance.choice(list(PLACES))
        PLACES[name](file)
    else:
        name = chance.choice(list(target.damages))
        file.write_bytes(target.damages[name](chance, file.read_bytes()))
    label = " ".join(door) if isinstance(door, list) else getattr(door, "__qualname__", "call")
    return Case(f"{target.file}: {name}", filled(door, folder), label, name == "no permission")


def filled(door: Door, folder: Path) -> Door:
    return [word.replace("{}", str(folder)) for word in door] if isinstance(door, list) else door


def files_of(folder: Path) -> Iterator[Path]:
    return (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
