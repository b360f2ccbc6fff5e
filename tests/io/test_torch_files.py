"""What ``torch.save`` wrote is read without running code, and without allocating what is only declared."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch

from bidnerf_core.io import read_saved
from refusals import refused

Saved = Callable[[Any], Path]


@pytest.fixture
def saved(tmp_path: Path) -> Saved:
    def save(content: Any) -> Path:
        torch.save(content, tmp_path / "a.ckpt")
        return tmp_path / "a.ckpt"

    return save


class Code:
    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


def test_numbers_of_numpy_do_not_prevent_reading(saved: Saved) -> None:
    """nerfstudio's trainer stores learning rates as such; they are no code, but torch refuses them."""
    path = saved({"weights": torch.arange(3.0), "schedulers": {"rate": np.float64(0.1), "step": np.int64(3)}})
    found = read_saved(path, "a checkpoint")
    assert torch.equal(found["weights"], torch.arange(3.0))
    assert not isinstance(found["schedulers"]["rate"], float)


def is_mapped(path: Path) -> bool:
    return str(path) in {part.path for part in psutil.Process().memory_maps()}


def test_the_outline_of_a_file_leaves_its_numbers_there(saved: Saved) -> None:
    path = saved({"weights": torch.rand(1000), "step": 3, "rate": np.float64(0.1)})
    whole = read_saved(path, "a checkpoint")
    assert not is_mapped(path)
    outline = read_saved(path, "a checkpoint", mapped=True)
    assert is_mapped(path)
    assert outline["step"] == 3
    assert torch.equal(outline["weights"], whole["weights"])


@pytest.mark.parametrize("mapped", [False, True])
def test_both_formats_of_torch_are_read(mapped: bool, tmp_path: Path) -> None:
    for zipped in (True, False):
        torch.save({"a": torch.arange(3.0)}, tmp_path / "a.pt", _use_new_zipfile_serialization=zipped)
        assert torch.equal(read_saved(tmp_path / "a.pt", "a checkpoint", mapped)["a"], torch.arange(3.0))


def test_code_is_refused_and_not_run(saved: Saved, tmp_path: Path) -> None:
    path = saved({"a": Code(f"touch {tmp_path}/mark")})
    for mapped in (True, False):
        with refused(where=path, found="would run code (posix.system)", expected="a checkpoint"):
            read_saved(path, "a checkpoint", mapped)
    assert not (tmp_path / "mark").exists()


def test_damage_and_absence_are_told_in_one_line(saved: Saved, tmp_path: Path) -> None:
    path = saved({"a": torch.zeros(100)})
    path.write_bytes(path.read_bytes()[:-200])
    for file, said in ((path, "damaged"), (tmp_path / "none", "no such file"), (tmp_path, "is a folder")):
        for mapped in (True, False):
            with refused(where=file, found=said, expected="a checkpoint"):
                read_saved(file, "a checkpoint", mapped)


def test_a_number_that_stands_for_many(saved: Saved) -> None:
    shared = torch.zeros(50)
    path = saved({"a": [shared, shared], "b": (shared[:20], shared.reshape(5, 10).t())})
    read_saved(path, "a checkpoint")
    for large in (torch.zeros(1).expand(10**9), torch.sparse_coo_tensor([[0]], [1.0], (10**9,))):
        path = saved({"a": [large]})
        with refused(where=path, found="unpacks to", expected="a checkpoint of at most 512 MiB in memory"):
            read_saved(path, "a checkpoint")
        assert read_saved(path, "a checkpoint", mapped=True)["a"][0].shape == large.shape


def test_a_list_that_contains_itself_is_refused(saved: Saved) -> None:
    endless: list[object] = [torch.zeros(2)]
    endless.append(endless)
    with refused(where=saved(endless), found="contains itself", expected="a checkpoint"):
        read_saved(saved(endless), "a checkpoint", mapped=True)


def test_an_archive_that_unpacks_to_more_than_its_size_is_not_unpacked(saved: Saved) -> None:
    path = saved({"a": torch.zeros(2**20)})
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    for mapped in (True, False):
        with refused(where=path, found="unpacks to 4 MiB", expected="a checkpoint that is not compressed"):
            read_saved(path, "a checkpoint", mapped)
