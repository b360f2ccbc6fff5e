"""Training continues from a checkpoint."""

from __future__ import annotations

import pytest
import torch

from bidnerf.testing import SCENE_BOUNDS, Recorder, rgb_views
from bidnerf_core.backend import load_backend
from bidnerf_core.errors import InputError
from bidnerf_core.training import Silent
from bidnerf_nerf_pytorch import NerfPytorchConfig, backend, read_checkpoint
from checkpoints import SMALL, Writer


def test_the_backend_is_found_by_name() -> None:
    assert load_backend("nerf-pytorch") is backend


def test_training_goes_on_from_a_checkpoint(write: Writer) -> None:
    path = write()
    config = NerfPytorchConfig(
        **vars(SMALL),
        coarse_samples=8,
        fine_samples=4,
        steps=1,
        rays_per_step=16,
        learning_rate=0.0,
        checkpoint=str(path),
    )
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
