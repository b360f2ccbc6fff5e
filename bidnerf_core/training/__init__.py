"""Shared parts of training recipes: batches of rays, the loss, and the loop with its schedule, checkpoints and resumption."""

from bidnerf_core.training.colour_transform import ColourTransforms, fitted_colours
from bidnerf_core.training.loop import StepOutcome, cosine, fit
from bidnerf_core.training.loss import ray_termination, supervised_loss
from bidnerf_core.training.ray_bank import RayBank, TrainingBatch
from bidnerf_core.training.report import Report, Silent, TrainingState, TrainingStep, TrainingStopped
from bidnerf_core.training.supervision import Supervision, SupervisionConfig

__all__ = [
    "ColourTransforms",
    "RayBank",
    "Report",
    "Silent",
    "StepOutcome",
    "Supervision",
    "SupervisionConfig",
    "TrainingBatch",
    "TrainingState",
    "TrainingStep",
    "TrainingStopped",
    "cosine",
    "fit",
    "fitted_colours",
    "ray_termination",
    "supervised_loss",
]
