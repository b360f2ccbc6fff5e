"""Checkpoints become maps, and training continues from one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from bidnerf_core.backend import load_backend
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.io import locked
from bidnerf_core.maps import load_info, load_map
from bidnerf_core.testing import SCENE_BOUNDS, Recorder, rgb_views
from bidnerf_core.training import Silent
from bidnerf_nerf_pytorch import NerfPytorchConfig, NerfPytorchField, backend, read_checkpoint
from bidnerf_nerf_pytorch.command import main
from checkpoints import SMALL, Writer, contents


def test_the_map_holds_the_networks(write: Writer, tmp_path: Path) -> None:
    assert main([str(write()), "--out", str(tmp_path / "map")]) == 0
    stored = load_map(tmp_path / "map")
    assert stored.info.backend == "nerf-pytorch"
    assert stored.info.complete
    assert (stored.info.step, stored.info.cameras) == (100, ())
    assert stored.bounds == SceneBounds((-1.5,) * 3, (1.5,) * 3, 2.0, 6.0, (1.0, 1.0, 1.0))
    expected = contents()
    assert isinstance(stored.field, NerfPytorchField)
    for level, key in (("coarse", "model_coarse_state_dict"), ("fine", "model_fine_state_dict")):
        for name, value in getattr(stored.field, level).network.state_dict().items():
            assert torch.equal(value, expected[key][name])


def test_options_are_those_of_the_map(write: Writer, tmp_path: Path) -> None:
    box = ["-1", "-2", "-3", "1", "2", "3.5"]
    options = ["--near", "0.5", "--far", "9", "--background", "black", "--fine-samples", "7", "--box", *box]
    assert main([str(write()), "--out", str(tmp_path / "map"), *options]) == 0
    info = load_info(tmp_path / "map")
    assert info.bounds == SceneBounds((-1.0, -2.0, -3.0), (1.0, 2.0, 3.5), 0.5, 9.0, (0.0, 0.0, 0.0))
    assert info.config["fine_samples"] == 7
    assert info.config["width"] == SMALL.width
    json.dumps(info.config)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(a) for a in arguments]) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "Traceback" not in said.err
    return said.err


def test_bad_input_is_told_in_one_line(
    write: Writer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, good = tmp_path / "map", write()
    assert "no such file" in refused(capsys, tmp_path / "none", "--out", out)
    assert "no fine network" in refused(
        capsys, write(contents() | {"model_fine_state_dict": None}, "a.ckpt"), "--out", out
    )
    assert "near 7.0, far 6.0" in refused(capsys, good, "--out", out, "--near", 7)
    assert "is not below" in refused(capsys, good, "--out", out, "--box", 0, 0, 0, 1, 1, 0)
    assert "coarse_samples is 0" in refused(capsys, good, "--out", out, "--coarse-samples", 0)
    assert not out.exists()
    assert "is a file, expected the name of a folder" in refused(capsys, good, "--out", good)


def test_a_map_is_replaced_only_where_that_is_wanted(
    write: Writer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "map"
    assert main([str(write()), "--out", str(out)]) == 0
    capsys.readouterr()
    assert "--overwrite" in refused(capsys, write(), "--out", out)
    assert main([str(write()), "--out", str(out), "--overwrite", "--near", "1"]) == 0
    assert load_map(out).bounds.near == 1.0
    capsys.readouterr()
    with locked(out):
        assert "another bidnerf process is writing here" in refused(
            capsys, write(), "--out", out, "--overwrite"
        )


def test_wrong_usage_has_a_status_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--nonsense"]) == 2
    assert main(["--help"]) == 0
    assert "CHECKPOINT" in capsys.readouterr().out


def test_the_backend_is_found_by_name() -> None:
    assert load_backend("nerf-pytorch") is backend


def test_training_goes_on_from_a_checkpoint(write: Writer) -> None:
    path = write()
    config = NerfPytorchConfig(
        **vars(SMALL), coarse_samples=8, fine_samples=4, steps=1, rays_per_step=16, learning_rate=0.0,
        checkpoint=str(path),
    )  # fmt: skip
    field = backend.build(config, SCENE_BOUNDS)
    backend.train(field, rgb_views(), config, Silent())
    for name, value in read_checkpoint(path).tensors.items():
        assert torch.equal(field.state_dict()[name], value)


def test_a_resumed_training_does_not_need_the_checkpoint(write: Writer) -> None:
    path = write()
    config = NerfPytorchConfig(
        **vars(SMALL), coarse_samples=8, fine_samples=4, steps=3, rays_per_step=16, checkpoint=str(path)
    )
    first, second = backend.build(config, SCENE_BOUNDS), backend.build(config, SCENE_BOUNDS)
    before = Recorder(due=(2,))
    backend.train(first, rgb_views(), config, before)
    path.unlink()
    backend.train(second, rgb_views(), config, Recorder(state=before.saved[0]))
    for name, value in first.state_dict().items():
        assert torch.equal(second.state_dict()[name], value)


def test_a_checkpoint_of_another_architecture_is_refused(write: Writer) -> None:
    config = NerfPytorchConfig(width=SMALL.width, layers=2, checkpoint=str(write()))
    with pytest.raises(InputError, match="layers 3, but the config says 2"):
        backend.train(backend.build(config, SCENE_BOUNDS), rgb_views(), config, Silent())
