"""Coarse and fine networks as trained by krrish94/nerf-pytorch; reads its checkpoints."""

from bidnerf_core.backend import RecipeBackend
from bidnerf_nerf_pytorch.checkpoint import Checkpoint, read_checkpoint
from bidnerf_nerf_pytorch.field import NerfPytorchField
from bidnerf_nerf_pytorch.recipe import NerfPytorchConfig, train

__all__ = ["Checkpoint", "NerfPytorchConfig", "NerfPytorchField", "backend", "read_checkpoint"]

backend = RecipeBackend(
    "coarse and fine networks as krrish94/nerf-pytorch trains them; reads its checkpoints",
    NerfPytorchConfig,
    NerfPytorchField,
    train,
)
