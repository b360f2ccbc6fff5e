"""Reading checkpoints: what is found in valid ones, and the errors for others."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch

from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_nerf_pytorch import NerfPytorchConfig, backend, read_checkpoint
from bidnerf_nerf_pytorch.network import NetworkConfig
from checkpoints import SMALL, Writer, contents

BOUNDS = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 6.0)

KINDS = [
    SMALL,
    NetworkConfig(),
    NetworkConfig(layers=8, width=32, skips=(5,)),
    NetworkConfig(layers=6, width=16, skips=(2, 4), position_frequencies=4),
    NetworkConfig(layers=1, width=16),
    NetworkConfig(layers=2, width=9, position_input=False, direction_frequencies=1, direction_input=False),
    NetworkConfig(layers=2, width=16, position_frequencies=0, direction_frequencies=0),
    NetworkConfig(layers=4, width=16, view_dependent=False),
    NetworkConfig(layers=4, width=16, octaves=False),
]


@pytest.mark.parametrize("config", KINDS, ids=str)
def test_architecture_is_read_off_the_weights(write: Writer, config: NetworkConfig) -> None:
    found = read_checkpoint(write(contents(config)), config.octaves)
    assert found.network == config
    assert found.steps == 100


def test_tensors_are_those_of_the_field(write: Writer) -> None:
    found = read_checkpoint(write())
    field = backend.build(NerfPytorchConfig(**vars(found.network)), BOUNDS)
    field.load_state_dict(found.tensors)
    expected = contents()
    for level, key in zip(
        (field.coarse, field.fine), ("model_coarse_state_dict", "model_fine_state_dict"), strict=True
    ):
        for name, value in level.network.state_dict().items():
            assert torch.equal(value, expected[key][name])


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_checkpoint(path)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(path))
    return message


def test_no_such_file(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "none.ckpt")
    assert "is a folder" in refusal(tmp_path)


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 broken", b"\x80\x02}q\x00"], ids=repr)
def test_not_a_checkpoint(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.ckpt"
    path.write_bytes(content)
    assert "not written by torch.save, or damaged" in refusal(path)


def test_a_file_that_ends_early(write: Writer) -> None:
    path = write()
    path.write_bytes(path.read_bytes()[:-1000])
    assert "not written by torch.save, or damaged" in refusal(path)


@pytest.mark.parametrize("found", [[], torch.zeros(3), {"state_dict": {}}, {"model_coarse_state_dict": None}])
def test_a_checkpoint_of_something_else(write: Writer, found: Any) -> None:
    assert "expected a nerf-pytorch checkpoint" in refusal(write(found))


@pytest.mark.parametrize("fine", [None, "missing"])
def test_no_fine_network(write: Writer, fine: str | None) -> None:
    found = contents() | {"model_fine_state_dict": None}
    if fine == "missing":
        del found["model_fine_state_dict"]
    assert "no fine network" in refusal(write(found))


class Code:
    """Runs a command when it is unpickled."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


def test_code_is_refused_and_not_run(write: Writer, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    message = refusal(write(contents() | {"psnr": Code(f"touch {mark}")}))
    assert "would run code" in message
    assert "system" in message
    assert not mark.exists()


def changed(**shapes: tuple[int, ...] | None) -> dict[str, Any]:
    """Return a checkpoint whose fine network has tensors of other shapes, or lacks those given as None."""
    found = contents()
    for name, shape in shapes.items():
        found["model_fine_state_dict"].pop(name.replace("__", "."), None)
        if shape is not None:
            found["model_fine_state_dict"][name.replace("__", ".")] = torch.zeros(shape)
    return found


@pytest.mark.parametrize(
    "found",
    [
        changed(layer1__weight=None),
        changed(layer1__weight=(16,)),
        changed(layer1__weight=(16, 20)),
        changed(layer1__weight=()),
        changed(layers_xyz__0__weight=(16, 17)),
        changed(layers_xyz__1__weight=None),
        changed(layers_xyz__2__weight=(16, 16)),
        changed(layers_dir__0__weight=(8, 16)),
        changed(layers_dir__0__weight=(3,)),
        changed(layers_dir__0__weight=()),
        changed(layers_dir__1__weight=(8, 8)),
        changed(fc_rgb__bias=None),
        changed(fc_rgb__bias=(4,)),
    ],
)
def test_unknown_architecture(write: Writer, found: dict[str, Any]) -> None:
    message = refusal(write(found))
    assert "fine network" in message
    assert "unknown architecture" in message


def test_networks_that_differ(write: Writer) -> None:
    other = contents(NetworkConfig(layers=2, width=16))["model_fine_state_dict"]
    assert "the networks differ" in refusal(write(contents() | {"model_fine_state_dict": other}))


@pytest.mark.parametrize("value", [torch.full((3,), torch.nan), torch.zeros(3, dtype=torch.long)])
def test_weights_that_are_no_numbers(write: Writer, value: torch.Tensor) -> None:
    found = contents()
    found["model_coarse_state_dict"]["fc_rgb.bias"] = value
    assert "'fc_rgb.bias' has values that are not finite numbers" in refusal(write(found))
