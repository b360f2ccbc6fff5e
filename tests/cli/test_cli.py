"""The command line: what it prints, what it says of bad input, and that it leaves nothing half-made behind."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import tiny
from bidnerf import Intrinsics, Outcome, scenes
from bidnerf.cli import COMMANDS, main

# Inside: a line of progress, without a training that takes as long as the line says
from bidnerf.cli.running import display_progress
from bidnerf.scenes import demo_object
from bidnerf.service import LocalizationBody
from bidnerf_core.backend import load_backend
from bidnerf_core.datasets import open_dataset
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import BakeConfig
from bidnerf_core.maps import Checkpoints, Localizer, MapInfo, check_resumable, load_info, load_map
from bidnerf_core.progress import counter
from bidnerf_core.training import TrainingStep
from commands import Run, assert_refused, quietly, strict
from trainings import assert_same_map, stop_at
from waiting import wait_until

QUICK = ["--method", "bid", "--perturb", "0.1", "5", "--max-steps", "3", "--rays", "64"]
Edit = Callable[[Path], Any]


@pytest.fixture(scope="module")
def half(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map whose training was stopped half-way."""
    out = tmp_path_factory.mktemp("half") / "map"
    with pytest.MonkeyPatch.context() as patch:
        stop_at(patch, tiny.STEPS // 2)
        assert main(["train", str(shared / "data"), "--out", str(out), *tiny.options()]) == 130
    return out


@pytest.fixture
def interrupted(half: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(half, tmp_path / "half"))


@pytest.fixture(scope="module")
def photos_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset without depth; a command names the frames that it takes from there."""
    return tiny.write_dataset(tmp_path_factory.mktemp("photos") / "data", depth=False)


def contents(folder: Path) -> dict[str, bytes | None]:
    files = sorted(folder.rglob("*"))
    return {str(f.relative_to(folder)): f.read_bytes() if f.is_file() else None for f in files}


@pytest.mark.parametrize(("samples", "shown"), [(math.nan, ""), (31.5, "  31.5 samples per ray")])
def test_a_line_of_progress_leaves_out_what_the_recipe_does_not_tell(
    samples: float, shown: str, capsys: pytest.CaptureFixture[str]
) -> None:
    info = MapInfo("fog", {}, demo_object().bounds, 0, complete=False)
    with display_progress():
        Checkpoints(info).step(TrainingStep(5, 5, 0.25, 6.0, samples))
    line = f"training: 5/5 steps, loss 0.25000  PSNR 6.00 dB{shown}, 0 s left\n"
    assert capsys.readouterr().err == line


@pytest.mark.parametrize(("total", "shown"), [(1, "localizing"), (3, "localizing: 1/3 images")])
def test_a_stage_that_is_silent_says_that_it_goes_on(
    total: int, shown: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf.cli.running.SILENCE", 0.05)
    with display_progress():
        counter("localizing", "images")(total // 2, total)
        wait_until(lambda: f"{shown}, 0 s so far\n" in capsys.readouterr().err, 20)


# Datasets that cannot be used.


def cut(name: str) -> Edit:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:60])


IMAGE, DEPTH = "images/r_0001.png", "depth/r_0001.png"
BAD_DATA: dict[str, tuple[Edit, str]] = {
    "no folder": (shutil.rmtree, "no such file or folder"),
    "broken JSON": (lambda folder: (folder / "transforms.json").write_text("["), "transforms.json: not JSON"),
    "truncated image": (cut(IMAGE), IMAGE),
}


@pytest.mark.parametrize("case", BAD_DATA)
def test_a_dataset_that_cannot_be_used_is_told_in_a_line(case: str, bidnerf: Run, data: Path, tmp_path: Path) -> None:
    edit, fault = BAD_DATA[case]
    edit(data)
    before = contents(tmp_path)
    outcome = bidnerf("train", data, "--out", tmp_path / "new" / "map", *tiny.options())
    assert_refused(outcome, 1, "bidnerf train: ", data, fault)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(("command", "damaged"), [("localize", IMAGE), ("localize", DEPTH), ("render", DEPTH)])
def test_the_frames_that_are_asked_for_are_judged_and_no_others(
    command: str, damaged: str, bidnerf: Run, shared: Path, data: Path, tmp_path: Path
) -> None:
    cut(damaged)(data)
    where = ["--out", tmp_path / "out"] if command == "render" else [*QUICK, "--rig"]
    arguments = [command, shared / "map", data, "--split", "train", *where, "--frame"]
    assert_refused(bidnerf(*arguments, "r_0000", "r_0001"), 1, data / damaged)
    assert not (tmp_path / "out").exists()
    assert bidnerf(*arguments, "r_0000").status == 0


def test_the_first_images_of_a_dataset_or_of_photos_are_used(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    place, first = (shared / "map", shared / "data"), ("--first", 2)
    rendered = bidnerf("render", *place, "--out", tmp_path / "out", *first).succeed().out
    assert [line.split()[0] for line in rendered.splitlines()] == ["t_0000", "t_0001", "mean"]
    for more, expected in (
        ((), ["t_0000", "t_0001"]),
        (("--frame", "t_0002", "t_0000", "t_0001"), ["t_0002", "t_0000"]),
    ):
        found = bidnerf("localize", *place, *QUICK, *first, *more, "--json").succeed().out
        assert [json.loads(line)["frame"] for line in found.splitlines()] == expected


def test_without_depth_colour_alone_is_used_and_that_is_said(bidnerf: Run, photos_only: Path, tmp_path: Path) -> None:
    trained = bidnerf("train", photos_only, "--out", tmp_path / "map", *tiny.options(2))
    assert (trained.status, trained.out) == (0, "")
    assert "training: 2/2 steps, loss " in trained.err
    assert [line for line in trained.err.splitlines() if "colour only" in line] == [
        f"{photos_only}: no measured depth in split 'train'; training on colour only"
    ]


def test_values_that_are_no_depth_are_mentioned_once(bidnerf: Run, shared: Path, data: Path, tmp_path: Path) -> None:
    for file in (data / "depth").glob("t_*.png"):
        depth = iio.imread(file)
        depth[0, :3] = 65535
        iio.imwrite(file, depth)
    outcome = bidnerf("render", shared / "map", data, "--out", tmp_path / "out")
    assert (outcome.status, outcome.err.count("\n")) == (0, 1)
    assert f"{data}/depth/t_0000.png: depth: treated as not measured: 3 x 65535" in outcome.err


# Maps that cannot be used.


def described(change: Callable[[dict[str, Any]], Any]) -> Edit:
    def edit(folder: Path) -> None:
        content = json.loads((folder / "map.json").read_text())
        change(content)
        (folder / "map.json").write_text(json.dumps(content))

    return edit


def weighted(change: Callable[[dict[str, torch.Tensor]], Any]) -> Edit:
    def edit(folder: Path) -> None:
        path = folder / load_info(folder).weights
        tensors = load_file(path)
        change(tensors)
        save_file(tensors, path)

    return edit


def into_a_file(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.touch()


@pytest.mark.parametrize(
    ("edit", "fault"),
    [
        (shutil.rmtree, "no such folder"),
        (lambda folder: (folder / "map.json").write_text("{"), "map.json: not JSON"),
        (lambda folder: cut(load_info(folder).weights)(folder), "weights-"),
    ],
    ids=["no folder", "broken JSON", "corrupt weights"],
)
def test_a_map_that_cannot_be_used_is_told_in_a_line(
    edit: Edit, fault: str, bidnerf: Run, shared: Path, map_folder: Path, tmp_path: Path
) -> None:
    edit(map_folder)
    before = contents(tmp_path)
    localize = [shared / "data", "--frame", "t_0000", *QUICK]
    for name, *words in (
        ["info"],
        ["render", shared / "data", "--out", tmp_path / "x"],
        ["localize", *localize],
    ):
        assert_refused(bidnerf(name, map_folder, *words), 1, f"bidnerf {name}: ", map_folder, fault)
    assert contents(tmp_path) == before


BIAS = "geometry.0.bias"
FAULTS: dict[str, tuple[Edit, tuple[str, ...]]] = {
    "empty folder": (lambda folder: [file.unlink() for file in folder.iterdir()], ("no map.json",)),
    "a file": (into_a_file, ("is a file", "a folder")),
    "another format": (described(lambda c: c.update(format="x")), ("map.json", "bidnerf map")),
    "newer": (described(lambda c: c.update(version=99)), ("map.json", "version 99", "upgrade bidnerf")),
    "older": (described(lambda c: c.update(version=0)), ("map.json", "version 0", "retrain")),
    "missing field": (described(lambda c: c.pop("bounds")), ("map.json", "bounds: missing")),
    "setting": (described(lambda c: c["config"].update(width=0)), ("map.json: config", "width is 0", "1 to")),
    "bounds": (described(lambda c: c["bounds"].update(lower=[9, 9, 9])), ("map.json: bounds", "9", "upper")),
    "unknown backend": (described(lambda c: c.update(backend="hashgird")), ("'hashgird'", "hashgrid")),
    "missing weights": (lambda folder: (folder / load_info(folder).weights).unlink(), ("weights-", "no such")),
    "weights elsewhere": (described(lambda c: c.update(weights="../x")), ("map.json", "'../x'")),
    "weight of another shape": (weighted(lambda t: t.update({BIAS: torch.ones(3)})), (BIAS, "[3]", "[16]")),
    "weight missing": (weighted(lambda t: t.pop(BIAS)), ("weights-", BIAS, "expected one of shape [16]")),
    "weight too many": (weighted(lambda t: t.update(more=torch.ones(3))), ("weights-", "'more'")),
}
"""Faults of maps that tests of their storage leave out."""


@pytest.mark.parametrize("case", FAULTS)
def test_what_is_wrong_with_a_map_is_named(case: str, bidnerf: Run, map_folder: Path) -> None:
    edit, named = FAULTS[case]
    edit(map_folder)
    assert_refused(bidnerf("info", map_folder), 1, map_folder, *named)


def test_what_cannot_be_resumed_is_told_in_a_line(
    bidnerf: Run, shared: Path, interrupted: Path, tmp_path: Path
) -> None:
    data, nowhere = shared / "data", tmp_path / "nowhere"
    other = tiny.write_dataset(tmp_path / "other", train=5)
    before = contents(interrupted)
    cases: list[tuple[list[Any], int, tuple[Any, ...]]] = [
        ([data, "--out", nowhere], 1, (nowhere, "nothing to resume")),
        ([data, "--out", shared / "map", "--no-bake"], 1, ("complete", "12 steps")),
        ([other, "--out", interrupted], 1, (other,)),
        ([data, "--out", interrupted, "--split", "test"], 1, ("'test'", "'data'")),
        ([data, "--out", interrupted, "--steps", "99"], 2, ("--steps 12", "99")),
        ([data, "--out", interrupted, "--base-resolution", "8"], 2, ("--base-resolution 4.0", "8.0")),
        ([data, "--out", interrupted, "--overwrite"], 2, ("--overwrite",)),
        ([data, "--out", interrupted, "--background", "black"], 2, ("background", "(0.0, 0.0, 0.0)")),
    ]
    for words, status, named in cases:
        assert_refused(bidnerf("train", "--resume", *words), status, *named)
    assert contents(interrupted) == before
    (interrupted / str(load_info(interrupted).training)).write_bytes(b"junk")
    assert_refused(bidnerf("train", data, "--resume", "--out", interrupted), 1, "training-")
    described(lambda content: content.update(backend="hashgird"))(interrupted)
    refused = bidnerf("train", data, "--resume", "--out", interrupted)
    assert_refused(refused, 1, interrupted, "'hashgird'", "hashgrid")


# Places that cannot be written.


@pytest.mark.parametrize("command", ["train", "render", "demo"])
def test_what_exists_is_not_overwritten_unasked(command: str, bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "precious").write_text("x")
    arguments = {
        "train": ["train", shared / "data", *tiny.options(1)],
        "render": ["render", shared / "map", shared / "data", "--frame", "t_0000"],
        "demo": ["demo"],
    }[command]
    before = contents(tmp_path)
    assert_refused(bidnerf(*arguments, "--out", out), 1, out, "exists already", "--overwrite")
    assert_refused(bidnerf(*arguments, "--out", out / "precious", "--overwrite"), 1, out / "precious", "a file")
    assert contents(tmp_path) == before
    if command != "demo":
        assert bidnerf(*arguments, "--out", out, "--overwrite").status == 0
        assert (out / "precious").read_text() == "x"
        assert len(list(out.iterdir())) > 1


@pytest.mark.parametrize("place", ["/dev/null/x", "/proc/x", "{file}/x/y", "/dev/null"])
def test_a_place_that_cannot_be_written_is_told_before_any_work(
    place: str, bidnerf: Run, shared: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    out = place.format(file=tmp_path / "file")
    train, render = ["train", shared / "data"], ["render", shared / "map", shared / "data"]
    for arguments in (train, render, ["demo", "--overwrite"]):
        assert_refused(bidnerf(*arguments, "--out", out), 1, out, "expected")
    assert contents(tmp_path) == {"file": b""}


def no_memory(*_: object) -> None:
    raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nSee the notes")


def test_a_gpu_without_memory_left_is_said_in_a_line(
    bidnerf: Run, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.optim.Adam, "step", no_memory)
    trained = bidnerf("train", shared / "data", "--out", tmp_path / "map", *tiny.options(2))
    assert_refused(trained, 1, "bidnerf train: ", "the GPU's memory is full", "--device cpu", after_remarks=True)


def test_a_full_disk_leaves_nothing_behind(
    bidnerf: Run, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
    out = tmp_path / "some" / "where"
    trained = bidnerf("train", shared / "data", "--out", out, *tiny.options(2))
    assert_refused(trained, 1, f"{out}/weights-", "No space left on device", after_remarks=True)
    rendered = bidnerf("render", shared / "map", shared / "data", "--out", out)
    assert_refused(rendered, 1, f"{out}/t_0000.png: No space left on device")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 KiB, where that may be made."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("mounting is not permitted here")
    yield place
    subprocess.run(["umount", str(place)], check=True, capture_output=True)


def test_a_disk_that_fills_up_keeps_the_last_whole_map(bidnerf: Run, shared: Path, small_disk: Path) -> None:
    """The finished map fits once (40 KiB), not twice, nor with its optimizer's state."""
    train = ["train", shared / "data", "--out", small_disk / "map", *tiny.options(2)]
    full = bidnerf(*train, "--checkpoint-every", "0")
    assert_refused(full, 1, "No space left on device", after_remarks=True)
    assert list(small_disk.iterdir()) == []
    assert bidnerf(*train).status == 0
    before = contents(small_disk)
    assert bidnerf(*train, "--overwrite").status == 1
    assert contents(small_disk) == before
    assert load_map(small_disk / "map").info.complete


# Wrong usage, beside ``wrong_arguments.txt``.


def test_an_argument_with_a_nul_is_wrong_usage(bidnerf: Run) -> None:
    assert_refused(bidnerf("info", "a\0b"), 2, "NUL")


def test_without_a_command_the_commands_are_listed(bidnerf: Run) -> None:
    nothing, asked = bidnerf(), bidnerf("--help")
    assert (nothing.status, nothing.out, nothing.err) == (2, "", asked.out)
    assert asked.status == 0
    assert all(f"  {name} " in asked.out for name in COMMANDS)
    for word, meant in (("rendr", "render"), ("--hlep", "--help")):
        error = f"bidnerf: no command {word!r}, did you mean {meant!r}?; 'bidnerf --help' lists all commands\n"
        assert bidnerf(word) == (2, "", error)
    assert bidnerf("--version").out.startswith("bidnerf ")


POSES = {
    "missing": (None, "no such file"),
    "not JSON": ("{", "not JSON"),
    "no pose": ("{}", "no matrix of numbers"),
    "text": ('"x"', "no matrix of numbers"),
    "ragged": ("[[1, 2], [3]]", "no matrix of numbers"),
    "two of --out": ('[{"frame": "a"}, {"frame": "b"}]', "holds no pose"),
    "two of --json": ('{"frame": "a"}\n{"frame": "b"}\n', "holds no pose"),
    "none": ("[]", "holds no pose"),
    "3x3": ("[[1, 0, 0], [0, 1, 0], [0, 0, 1]]", "(3, 3)"),
    "by columns": ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]", "column-major"),
    "last row": ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 1, 1, 1]]", "last row"),
    "huge": (f"[[1{'0' * 400}, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "no matrix of numbers"),
    "NaN": ("[[NaN, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]", "holds numbers that are NaN or infinite"),
    "scaled": ("[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]", "rigid"),
}


@pytest.mark.parametrize("case", POSES)
def test_a_start_that_is_no_pose_is_told_in_a_line(case: str, bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    text, fault = POSES[case]
    path = tmp_path / "pose.json"
    if text is not None:
        path.write_text(text)
    found = bidnerf("localize", shared / "map", shared / "data", "--frame", "t_0000", "--start", path)
    assert_refused(found, 1, path, fault, "expected")


# What is printed.


@pytest.mark.parametrize("frames", [["t_0000"], ["t_0000", "t_0001", "t_0002"]], ids=["one", "rig"])
def test_localize_prints_the_object_that_was_agreed_on(
    frames: list[str], bidnerf: Run, shared: Path, tmp_path: Path
) -> None:
    quick = ["--method", "bid", "--max-steps", "3", "--rays", "64"]
    localize = ["localize", shared / "map", shared / "data", "--json", *quick]
    outcome = bidnerf(*localize, "--perturb", "0.1", "5", "--rig", "--frame", *frames).succeed()
    found = strict(outcome.out)
    assert {*found} == {*LocalizationBody.model_fields} - {"map", "similarity", "runner_up"}
    LocalizationBody.model_validate(found | {"error": None}, strict=True)
    assert set(found["error"]) == {"translation", "rotation_deg"}
    assert (found["frame"], found["backend"]) == (frames[-1], "hashgrid")
    # What it prints is a start that it takes.
    (tmp_path / "pose.json").write_text(outcome.out)
    again = bidnerf(*localize, "--start", tmp_path / "pose.json", "--rig", "--frame", *frames).succeed()
    rigid = torch.tensor(strict(again.out)["T_world_camera"])
    assert torch.allclose(rigid[:3, :3] @ rigid[:3, :3].T, torch.eye(3), atol=1e-5)


def test_each_frame_of_a_rig_counts_once(bidnerf: Run, shared: Path, photos_only: Path) -> None:
    place = ["localize", shared / "map", photos_only, *QUICK]
    several = bidnerf(*place, "--rig", "--frame", "t_0000", "t_0001", "--frame", "t_0002")
    assert (several.status, several.err) == (0, "t_0000, t_0001, t_0002: no measured depth; colour only\n")


def test_a_window_is_the_frame_and_those_before_it(bidnerf: Run, shared: Path, photos_only: Path) -> None:
    place = ["localize", shared / "map", photos_only, *QUICK]
    for frame, size, taken in (
        ("t_0002", 2, "t_0001, t_0002"),
        ("t_0001", 3, "t_0000, t_0001"),
        ("t_0001", 1, "t_0001"),
    ):
        found = bidnerf(*place, "--frame", frame, "--window", size).succeed()
        assert found.err.endswith(f"{taken}: no measured depth; colour only\n")
        cut = "--window 3: t_0001 has only 1 before it" in found.err
        assert cut == (size == 3)


def test_localize_without_json_prints_to_stdout_too(bidnerf: Run, shared: Path) -> None:
    found = bidnerf("localize", shared / "map", shared / "data", "--frame", "t_0001", *QUICK)
    assert (found.status, found.err) == (0, "")
    assert re.match(r"t_0001: error \d\.\d{4} m, \d+\.\d{3} deg; refused: ", found.out)


def test_an_answer_that_is_not_finite_is_no_answer(bidnerf: Run, shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Localizer.__call__
    nowhere = SE3(torch.eye(3).double(), torch.full((3,), math.nan).double())
    monkeypatch.setattr(
        Localizer,
        "__call__",
        lambda *given, **more: replace(real(*given, **more), T_world_camera=nowhere, outcome=Outcome.CONVERGED),
    )
    found = bidnerf("localize", shared / "map", shared / "data", "--frame", "t_0001", *QUICK, "--json")
    assert_refused(found, 1, "t_0001", "not finite")


def test_backends_are_listed(bidnerf: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    listed = strict(bidnerf("backends", "--json").out)
    assert "hashgrid" in [entry["name"] for entry in listed]
    assert {"name", "summary", "distribution", "version", "value", "fault"} == set(listed[0])
    shown = bidnerf("backends")
    assert (shown.status, shown.err) == (0, "")
    assert all(entry["name"] in shown.out for entry in listed)
    (row,) = [entry for entry in listed if entry["name"] == "hashgrid"]
    assert row["summary"] == load_backend("hashgrid").summary


def test_info_describes_a_map(bidnerf: Run, shared: Path) -> None:
    facts = strict(bidnerf("info", shared / "map", "--json").out)
    assert (facts["backend"], facts["data"], facts["config"]["encoding"]["levels"]) == ("hashgrid", "data", 3)
    assert (facts["cameras"], facts["step"], facts["complete"], facts["levels"]) == (6, tiny.STEPS, True, 2)
    shown = bidnerf("info", shared / "map").out
    for part in (
        f"{facts['step']} steps of backend hashgrid",
        "data, 6 images",
        "surface:     none; 'bidnerf bake MAP'",
        "landmarks:   none; 'bidnerf bake MAP --data DATA'",
        "levels 3",
        "nothing beyond it",
    ):
        assert part in shown
    assert "distances" not in shown  # which are known


def test_render_refuses_names_whose_files_would_collide(bidnerf: Run, shared: Path, data: Path, tmp_path: Path) -> None:
    path = data / "transforms.json"
    first, second = json.loads(path.read_text())["test_filenames"][:2]
    other = str(Path(first).with_name(f"{Path(first).stem}.depth.png"))
    (data / second).rename(data / other)
    path.write_text(path.read_text().replace(second, other))
    refused = bidnerf("render", shared / "map", data, "--out", tmp_path / "out")
    assert_refused(refused, 1, "would overwrite the depth of", "--frame")
    assert not (tmp_path / "out").exists()


def test_render_writes_the_images_that_were_agreed_on(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    render = ["render", shared / "map", shared / "data"]
    outcome = bidnerf(*render, "--out", tmp_path / "all")
    assert (outcome.status, outcome.err) == (0, "")
    names = {f"t_000{i}{end}" for i in range(3) for end in (".png", ".depth.png")}
    assert {file.name for file in (tmp_path / "all").iterdir()} == names
    image, depth = iio.imread(tmp_path / "all/t_0000.png"), iio.imread(tmp_path / "all/t_0000.depth.png")
    assert (image.shape, image.dtype) == ((24, 24, 3), np.uint8)
    assert (depth.shape, depth.dtype) == ((24, 24), np.uint16)
    assert outcome.out.count("PSNR") == 4
    one = [*render, "--out", tmp_path / "one", "--frame", "t_0001", "--level"]
    assert bidnerf(*one, "0").status == 0
    assert {f.name for f in (tmp_path / "one").iterdir()} == {"t_0001.png", "t_0001.depth.png"}
    fine = (tmp_path / "all/t_0001.png").read_bytes()
    assert (tmp_path / "one/t_0001.png").read_bytes() != fine
    assert bidnerf(*one, "1", "--overwrite").status == 0
    assert (tmp_path / "one/t_0001.png").read_bytes() == fine


# Training that is interrupted.


def test_ctrl_c_saves_and_resuming_loses_nothing(
    bidnerf: Run, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the background nor another setting has to be given again."""
    data, whole, half = shared / "data", tmp_path / "whole", tmp_path / "half"
    train = ["train", data, "--background", "black", *tiny.options(8)]
    assert bidnerf(*train, "--out", whole).status == 0
    with monkeypatch.context() as patch:
        stop_at(patch, 5)
        stopped = bidnerf(*train, "--out", half)
    saved = f"{half}: saved after step 5; --resume continues from there"
    assert (stopped.status, stopped.out) == (130, "")
    assert stopped.err.splitlines()[-2:] == [saved, "bidnerf train: interrupted"]
    assert bidnerf("info", half).status == 0
    # A setting that is given again is compared with its own value alone, not with defaults of the others.
    resumed = bidnerf("train", data, "--out", half, "--resume", "--no-bake", "--base-resolution", "4")
    assert (resumed.status, resumed.out) == (0, "")
    assert "resuming from step 5" in resumed.err
    assert sorted(file.suffix for file in half.iterdir()) == [".json", ".safetensors"]
    assert_same_map(half, whole)


def test_another_signal_says_what_is_kept_and_how_to_go_on(
    bidnerf: Run, data: Path, interrupted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C waits for the next step of the work; SIGTERM and a second Ctrl-C do not."""

    def stop(*_: Any, **more: Any) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("bidnerf_core.maps.training.bake_if_possible", stop)
    monkeypatch.setattr("bidnerf.scenes.views", stop, raising=False)
    monkeypatch.setattr("bidnerf_core.maps.training.read_views", stop)
    demo, new, matched = tmp_path / "demo", tmp_path / "new", tmp_path / "matched"
    matched.mkdir()
    (matched / "training-000000000-0123abcd.safetensors").touch()
    for command, line in (
        (
            ["train", data, "--out", interrupted, "--finish"],
            f"{interrupted}: stopped; the map keeps its finished parts and the last checkpoint; --resume continues,"
            " --finish ends it as it is",
        ),
        (
            ["demo", "--out", demo],
            f"stopped; the demo cannot be continued, 'bidnerf demo --out {demo} --overwrite' starts again",
        ),
        (
            ["train", data, "--out", new],
            f"{new}: stopped before anything of the map was saved; the same command starts again",
        ),
        (
            ["train", data, "--out", matched],
            f"{matched}: stopped; the matches of its keypoints are kept, and the same command goes on from there",
        ),
    ):
        stopped = bidnerf(*command)
        assert (stopped.status, stopped.err.splitlines()[-2:]) == (143, [line, f"bidnerf {command[0]}: interrupted"])
    assert check_resumable(interrupted).complete  # what is left to do is to bake it


def test_ctrl_c_before_anything_is_made_leaves_nothing(
    bidnerf: Run, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf_core.maps.training.read_views", Mock(side_effect=KeyboardInterrupt))
    outcome = bidnerf("train", shared / "data", "--out", tmp_path / "map")
    assert (outcome.status, outcome.err) == (130, "bidnerf train: interrupted\n")
    assert list(tmp_path.iterdir()) == []


def test_a_diverging_training_is_told_and_leaves_nothing(
    bidnerf: Run, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def overflow(optimizer: torch.optim.Optimizer) -> None:
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.data.fill_(torch.nan)

    monkeypatch.setattr(torch.optim.Adam, "step", overflow)
    outcome = bidnerf("train", shared / "data", "--out", tmp_path / "map", *tiny.options())
    assert_refused(outcome, 1, "training diverged", "smaller learning rate")
    assert list(tmp_path.iterdir()) == []


# Processes of their own.

PROGRAM = [sys.executable, "-c", "import sys; from bidnerf.cli import main; sys.exit(main())"]


@pytest.mark.parametrize(("code", "status"), [(None, 0), (3, 3), ("no licence", 1)])
def test_a_plugin_that_exits_ends_the_command_with_its_status(
    bidnerf: Run, monkeypatch: pytest.MonkeyPatch, code: object, status: int
) -> None:
    def leave() -> None:
        """Leave."""
        raise SystemExit(code)

    monkeypatch.setattr("bidnerf.cli.plugins.run_backends", leave)
    assert bidnerf("backends").status == status


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_reader_that_goes_away_and_an_output_that_is_full() -> None:
    reading, gone = os.pipe()
    os.close(reading)
    with open(gone, "w") as pipe, open("/dev/full", "w") as full:
        ran = [
            subprocess.run([*PROGRAM, "--help"], stdout=out, stderr=subprocess.PIPE, text=True) for out in (pipe, full)
        ]
    assert [(each.stderr, each.returncode) for each in ran] == [
        ("", 141),
        ("bidnerf: No space left on device\n", 1),
    ]


def test_closed_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python has None where the shell closed a stream."""
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert main(["backends", "--json"]) == 0
    assert main(["backends"]) == 0
    assert main(["frobnicate"]) == 2
    assert main(["info", "/nowhere"]) == 1


@pytest.mark.slow
def test_the_demo_leaves_a_map_and_the_data_that_it_was_made_from(
    bidnerf: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = Intrinsics(87.5, 87.5, 32.0, 32.0, 64, 64)
    monkeypatch.setattr(scenes, "views", lambda scene, camera, poses, seen=scenes.views: seen(scene, small, poses))
    for name, less in (("TRAINING_VIEWS", 12), ("DESCENT", {"rays": 64, "max_steps": 5})):
        monkeypatch.setattr(f"bidnerf.cli.demo.{name}", less)
    monkeypatch.setattr("bidnerf_core.maps.training.USUAL_BAKE", BakeConfig(cells=20_000))
    out = tmp_path / "out"
    made = bidnerf("demo", "--steps", 5, "--frames", 1, "--out", out)
    assert made.status == 0
    assert re.search(r"the field renders the 1 others with a PSNR of \d+\.\d dB", made.out)
    lines = made.out.splitlines()
    (head,) = [line for line in lines if re.split(r"\s{2,}", line.strip())[:2] == ["frame", "method"]]
    assert re.split(r"\s{2,}", head.strip())[2:] == ["error of the start", "error of the pose", "accepted", "CPU time"]
    begun = [line.split()[:3] for line in lines[lines.index(head) + 1 :][:2]]
    assert [(method, start == "none") for _, method, start in begun] == [("auto", True), ("bid", False)]
    assert not [line for line in lines if line != line.rstrip()]
    (hint,) = [line for line in lines if line.startswith("ask for a photo: bidnerf ")]
    assert bidnerf(*hint.split()[5:]).out.startswith("0000: ")
    data = open_dataset(out / "data")
    assert len(data.views("train")) == len(load_map(out / "map").info.cameras)
    [view] = data.views("test")
    found = json.loads(bidnerf("localize", out / "map", out / "data", *QUICK, "--json").out)
    assert found["frame"] == view.frame.name


@pytest.mark.slow
def test_localizing_imports_nothing_that_only_other_work_needs() -> None:
    others = "imageio scipy.optimize matplotlib viser pycolmap av jinja2 uvicorn torch._dynamo"
    program = "import sys, bidnerf as bn, bidnerf.cli.localize; bn.Localizer, bn.load_map; print(*sys.modules)"
    imported = {*quietly([sys.executable, "-c", program]).split()}
    assert "bidnerf_core.maps.localizer" in imported
    assert not {*others.split()} & imported


def test_what_the_program_starts_imports_nothing_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "multiprocessing.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    monkeypatch.setattr(sys, "argv", ["bidnerf", "--version"])
    words = [sys.executable, "-c", "import multiprocessing.spawn"]  # as a pool of processes starts its workers
    assert subprocess.run(words, cwd=tmp_path, capture_output=True).returncode == 1
    assert main() == 0
    assert subprocess.run(words, cwd=tmp_path, capture_output=True).returncode == 0
