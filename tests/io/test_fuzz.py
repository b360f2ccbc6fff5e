"""Malformed files end in one line, whatever is wrong with them: drawn files and options, and each defect that was found."""

from __future__ import annotations

import functools
import json
import os
import shutil
import struct
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import save

import tiny
from bidnerf import Frame, load_map
from bidnerf.evaluation import read_results
from bidnerf.results import read_pose
from bidnerf_core.camera import read_camera
from bidnerf_core.datasets import open_dataset, read_model
from bidnerf_core.depth import read_depth_image
from bidnerf_core.errors import InputError, printable
from bidnerf_core.io import (
    read_array,
    read_header,
    read_image,
    read_record,
    read_tensors,
)
from bidnerf_hashgrid import backend
from commands import Run
from damage import (
    Damages,
    array_file,
    draw_damage,
    of_array,
    of_bytes,
    of_colmap,
    of_image,
    of_json,
    of_points,
    of_tensors,
)
from scan_layouts import LAYOUTS, read_all, small_views


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of sound files of every kind."""
    from harness import sound_folder

    return sound_folder(tmp_path_factory.mktemp("fuzz") / "sound")


READERS: dict[str, tuple[str, Callable[[bytes], Damages], Callable[[Path], object]]] = {
    # The name of a sound file in the folder, what can be wrong with it, and what reads it.
    "record": ("data/transforms_train.json", of_json, read_record),
    "dataset": ("data/transforms_train.json", of_json, lambda p: open_dataset(p.parent).views("train")),
    "camera": ("camera.json", of_json, lambda p: read_camera(p, (24, 24))),
    "pose": ("pose.json", of_json, read_pose),
    "map": ("map/map.json", of_json, lambda p: load_map(p.parent)),
    "results": ("pose.json", of_json, lambda p: read_results([p])),
    "image": ("photo.png", of_image, read_image),
    "photo": ("photo.png", of_image, lambda p: Frame.open(p, hfov=40.0)),
    "depth": ("photo.depth.png", of_image, lambda p: read_depth_image(p, 0.001)),
    "depth array": ("photo.depth.npy", of_array, lambda p: read_depth_image(p, 0.001)),
    "weights": ("map/weights-*", of_tensors, lambda p: load_map(p.parent)),
    "COLMAP points": ("text/points3D.txt", of_points, lambda p: read_model(p.parent)),
    "COLMAP images": ("text/images.txt", of_points, lambda p: read_model(p.parent)),
    "COLMAP points, binary": ("colmap/sparse/0/points3D.bin", of_colmap, lambda p: read_model(p.parent)),
    "COLMAP images, binary": ("colmap/sparse/0/images.bin", of_colmap, lambda p: read_model(p.parent)),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", READERS)
def test_a_damaged_file_is_refused_in_one_line_or_read(kind: str, sound: Path, tmp_path: Path) -> None:
    pattern, damages, read = READERS[kind]
    copy = Path(shutil.copytree(sound, tmp_path / "copy"))
    (file,) = copy.glob(pattern)
    count = Counter[bool]()

    @settings(max_examples=20)
    @given(damaged=draw_damage(damages(file.read_bytes())))
    def judged(damaged: tuple[str, bytes]) -> None:
        file.write_bytes(damaged[1])
        count[refused(functools.partial(read, file))] += 1

    judged()
    assert count[True] >= 5


FORMATS = {
    ".json": of_json,
    ".png": of_image,
    ".jpg": of_bytes,
    ".bin": of_colmap,
    ".txt": of_points,
    ".csv": of_points,
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", LAYOUTS)
def test_a_dataset_with_a_damaged_file_is_refused_in_one_line_or_read(kind: str, tmp_path: Path) -> None:
    """Any file of a capture, whatever its layout."""
    folder = LAYOUTS[kind].write(tmp_path, small_views(4))
    sound = {file: file.read_bytes() for file in sorted(tmp_path.rglob("*")) if file.is_file()}
    chosen = st.sampled_from(list(sound))
    count = Counter[bool]()

    @settings(max_examples=12)
    @given(
        case=chosen.flatmap(
            lambda file: st.tuples(st.just(file), draw_damage(FORMATS.get(file.suffix, of_bytes)(sound[file])))
        )
    )
    def judged(case: tuple[Path, tuple[str, bytes]]) -> None:
        file, (_, content) = case
        file.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                count[refused(lambda: read_all(folder, **LAYOUTS[kind].options))] += 1
        finally:
            file.write_bytes(sound[file])

    judged()
    assert count[True] >= 3


def refused(read: Callable[[], object]) -> bool:
    """Return whether ``read`` raises an ``InputError``, which has one line. No other error may come."""
    try:
        read()
    except InputError as error:
        message = str(error)
    else:
        return False
    assert "\n" not in message
    return True


WORDS = st.text(max_size=6) | st.sampled_from(
    [
        "info",
        "train",
        "render",
        "localize",
        "evaluate",
        "compare",
        "report",
        "bake",
        "backends",
        "--out",
        "--seed",
        "--json",
        "--size",
        "--trials",
        "--nothing",
        "--frame",
        "--help",
        "--split",
        "--method",
        "--level",
        "\x1b[2J",
        "�",
        "1e400",
        "-1",
        "nan",
        "a/b",
    ]
)


@settings(max_examples=30)
@given(words=st.lists(WORDS, max_size=4))
def test_any_words_end_in_a_status_and_printable_text(words: list[str], bidnerf: Run) -> None:
    status, out, err = bidnerf(*words)
    assert status in (0, 1, 2)
    assert "Traceback" not in out + err
    assert all(c == "\n" or c.isprintable() or c == "\udcff" for c in out + err)
    assert status == 0 or err


# Files in the place of which something else stands.


def hollow(path: Path) -> None:
    """Four gigabytes of which the disk holds nothing."""
    path.touch()
    os.truncate(path, 4 * 2**30)


NO_FILES: dict[str, tuple[str, Callable[[Path], object], str]] = {
    # A name, what is made of that name, and what is said of it.
    "a pipe": ("x", os.mkfifo, "is a named pipe"),
    "a folder": ("x", Path.mkdir, "is a folder"),
    "a device": ("x", lambda path: path.symlink_to("/dev/zero"), "is a device"),
    "the kernel's": ("x", lambda path: path.symlink_to("/proc/self/status"), "is no regular file"),
    "nothing": ("x", lambda path: None, "no such file"),
    "a zero byte": ("a\0b", lambda path: None, "cannot be opened"),
    "a long name": ("a" * 300, lambda path: None, "cannot be opened"),
    "4 GB": ("x", hollow, "expected"),
}
FILES: dict[str, Callable[[Path], object]] = {
    "record": read_record,
    "pose": read_pose,
    "results": lambda p: read_results([p]),
    "tensors": read_tensors,
    "camera": lambda p: read_camera(p, (24, 24)),
    "array": lambda p: read_array(p, "an array"),
    "image": read_image,
    "header of an image": read_header,
}


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("what", NO_FILES)
def test_what_is_no_file_of_a_usable_size_is_refused_before_it_is_read(kind: str, what: str, tmp_path: Path) -> None:
    name, make, said = NO_FILES[what]
    make(tmp_path / name)
    with pytest.raises(InputError, match=said):
        FILES[kind](tmp_path / name)


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        ("<f8", "(100000, 100000)"),
        ("<f8", "(1000000000000,)"),
        ("<f8", "(-1, 3)"),
        ("<f8", "(1, 2"),
        ("<f8", "(" * 500),
        ("O", "(2,)"),
    ],
)
def test_arrays_are_judged_by_their_header(kind: str, shape: str, tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(array_file(kind, shape))
    with pytest.raises(InputError, match="not readable as an array"):
        read_array(tmp_path / "a.npy", "a .npy file")


def test_a_field_that_needs_numbers_to_be_built_is_loaded_too(
    map_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def build(self: Any, config: Any, bounds: Any) -> Any:
        made = real(self, config, bounds)
        float(next(iter(made.parameters())).flatten()[0])  # fails where there are shapes only
        return made

    real = type(backend).build
    monkeypatch.setattr(type(backend), "build", build)
    assert load_map(map_folder).info.step == tiny.STEPS


@pytest.mark.parametrize(
    "tensors",
    [b"", b"\0" * 8, save({"a": tiny.torch.zeros(3)})[:-1], save({"a": tiny.torch.zeros(3)}) + b"\0"],
)
def test_a_file_of_tensors_has_the_length_that_its_header_says(tensors: bytes, tmp_path: Path) -> None:
    (tmp_path / "t").write_bytes(tensors)
    with pytest.raises(InputError, match="expected a safetensors file"):
        read_tensors(tmp_path / "t")


ENTRY = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}


@pytest.mark.parametrize(
    "header",
    [
        {"a": ENTRY, "b": ENTRY},
        {"a": ENTRY | {"data_offsets": [-8, 8]}},
        {"a": ENTRY | {"data_offsets": ["0", "8"]}},
        {"a": ENTRY | {"data_offsets": [0, 2**70]}},
        {"a": ENTRY | {"shape": [10**30]}},
        {"a": ENTRY | {"shape": [1] * 65 + [2]}},
        {"a": [1]},
        {"__metadata__": [1], "a": ENTRY},
        {"__metadata__": {"x": 1}, "a": ENTRY},
        [],
        3,
    ],
    ids=lambda header: json.dumps(header)[:40],
)
def test_a_header_of_tensors_that_contradicts_itself_is_refused(header: Any, tmp_path: Path) -> None:
    text = json.dumps(header).encode()
    (tmp_path / "t").write_bytes(struct.pack("<Q", len(text)) + text + bytes(8))
    with pytest.raises(InputError, match="expected a safetensors file") as caught:
        read_tensors(tmp_path / "t")
    assert len(str(caught.value)) < 400 + len(str(tmp_path))


@pytest.mark.parametrize(
    "words",
    [["backends", "--x\x1b[2Jy"], ["info", "a", "b\x9b31m"], ["info", "a", "--json", "\x1b]0;x\x07"]],
)
def test_wrong_usage_repeats_no_control_characters(words: list[str], bidnerf: Run) -> None:
    status, out, err = bidnerf(*words)
    assert status == 2
    assert all(c == "\n" or c.isprintable() for c in out + err)
    assert printable(words[-1])[:4] in err


@pytest.mark.usefixtures("small_images")
def test_results_and_reports_go_into_odd_names_and_not_into_pipes(bidnerf: Run, tmp_path: Path) -> None:
    """A name could control the terminal, and a pipe in the place of a page could hang the report."""
    out = tmp_path / "\x1b[2Jr.jsonl"
    quick = ["--trials", 1, "--workers", 1, "--method", "bid", "--max-steps", 1, "--rays", 32]
    _, said, err = bidnerf("evaluate", "demo:blobs", "--out", out, *quick).succeed()
    assert "\x1b" not in said + err
    assert "\\x1b[2Jr.jsonl" in said
    (tmp_path / "out").mkdir()
    os.mkfifo(tmp_path / "out" / "index.html")
    status, _, err = bidnerf("report", out, "--out", tmp_path / "out")
    assert status == 1
    assert "holds something other than a bidnerf report" in err
