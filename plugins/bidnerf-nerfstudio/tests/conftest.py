"""Runs of nerfstudio, as ``make_runs.py`` made them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

from drawn import drawn
from stored_runs import RUNS, RunOf

torch.set_num_threads(1)

PREFIX = "_model."


@pytest.fixture
def run_of(tmp_path: Path) -> RunOf:
    """A function that returns a copy of the run of a method, with a checkpoint of drawn weights where none is stored."""

    def copied(method: str) -> Path:
        folder = tmp_path / method
        shutil.copytree(RUNS / method, folder)
        if not (folder / "nerfstudio_models").exists():
            known = json.loads((folder / "tensors.json").read_text())
            tensors = drawn(known["drawn"]) | {name: torch.tensor(value) for name, value in known["others"].items()}
            (folder / "nerfstudio_models").mkdir()
            pipeline = {PREFIX + name: value for name, value in tensors.items()}
            torch.save({"step": 9, "pipeline": pipeline}, folder / "nerfstudio_models" / "step-000000009.ckpt")
        return folder

    return copied
