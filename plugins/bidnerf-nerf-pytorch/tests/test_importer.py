"""Checkpoints through ``bidnerf import``."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from bidnerf import ImportOptions, import_map
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.maps import importer_of
from bidnerf_nerf_pytorch import NerfPytorchField
from bidnerf_nerf_pytorch.importer import importer
from checkpoints import SMALL, Writer, contents


def test_a_checkpoint_is_recognised_and_imported(write: Writer) -> None:
    assert importer_of(write())[0] == "nerf-pytorch"
    few = {"coarse_samples": 8, "fine_samples": 7}
    scene = import_map(write(), config={"near": 1.0, "background": "black", **few}, bake=False)
    assert scene.info.backend == "nerf-pytorch"
    assert (scene.bounds.near, scene.bounds.background) == (1.0, (0.0, 0.0, 0.0))
    assert scene.info.cameras


def test_the_map_holds_the_networks_and_the_options(write: Writer) -> None:
    box = (-1.0, -2.0, -3.0, 1.0, 2.0, 3.5)
    scene = import_map(write(), config={"far": 9.0, "coarse_samples": 8, "fine_samples": 7, "box": box}, bake=False)
    assert (scene.info.step, scene.info.complete) == (100, True)
    assert scene.bounds == SceneBounds(box[:3], box[3:], 2.0, 9.0, (1.0, 1.0, 1.0))
    assert (scene.info.config["fine_samples"], scene.info.config["width"]) == (7, SMALL.width)
    assert isinstance(scene.field, NerfPytorchField)
    for level, key in (("coarse", "model_coarse_state_dict"), ("fine", "model_fine_state_dict")):
        for name, value in getattr(scene.field, level).network.state_dict().items():
            assert torch.equal(value, contents()[key][name])


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"near": 7.0}, "near 7.0, far 6.0"),
        ({"box": (0.0, 0.0, 0.0, 1.0, 1.0, 0.0)}, "is not below"),
        ({"coarse_samples": 0}, "coarse_samples is 0"),
    ],
)
def test_options_that_contradict_are_refused(write: Writer, config: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        import_map(write(), config=config, bake=False)


def test_other_files_are_not(write: Writer) -> None:
    assert not importer.recognises(write({"model": 1}, "other.ckpt"))
    assert not importer.recognises(write({"model": 1}, "other.txt"))
    assert not importer.recognises(write().parent / "none.ckpt")


def test_networks_stay_where_they_were_trained(write: Writer) -> None:
    with pytest.raises(InputError, match="cannot be moved or scaled"):
        import_map(write(), bake=False, options=ImportOptions(scale=2.0))
