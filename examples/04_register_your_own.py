"""Coloured fog on a grid: a field of your own, registered in this process, trained and localized against by name.

python examples/04_register_your_own.py (plugins/bidnerf-template is one that pip installs)
"""

from dataclasses import dataclass

import torch
from torch.nn.functional import grid_sample, softplus

import bidnerf as bn
from bidnerf.scenes import closed_form_data
from bidnerf_core.backend import FieldValues, RecipeBackend, Stratified, Supervision, SupervisionConfig


@dataclass(frozen=True)
class FogConfig(SupervisionConfig):
    seed: int = 0
    steps: int = 400


class Fog(torch.nn.Module):
    def __init__(self, config, bounds):
        super().__init__()
        self.bounds, self.sampler = bounds, Stratified(64, bounds)
        self.grid = torch.nn.Parameter(torch.zeros(1, 4, 48, 48, 48))

    def query(self, positions, directions):
        places = self.bounds.normalized(positions).reshape(1, -1, 1, 1, 3)  # in [-1, 1]
        raw = grid_sample(self.grid, places, align_corners=True).reshape(4, *positions.shape[:-1])
        return FieldValues(softplus(raw[0] - 4) * 100 / self.bounds.side, raw[1:].sigmoid().movedim(0, -1))


def recipe(field, views, config, report):
    rays = Supervision(views, field.bounds, config, field.grid.device)
    groups = [{"params": [field.grid], "lr": 0.1}]
    rays.fit(field, groups, lambda _, generator: rays.step(field, 512, generator), config.steps, report)


bn.register("backends", "fog", RecipeBackend("a grid of coloured fog", FogConfig, Fog, recipe))
scene = bn.train(data := closed_form_data("demo:object"), "fog", bake=False)
plan = bn.Plan(protocol="bid", sizes=[0.4], method="bid", config={"max_steps": 100}, trials=1)
print(table := bn.evaluate(scene, data, plan))
start, end = table.rows[0].start_error.translation, table.rows[0].error.translation
print("success" if end < start / 10 else "no success", f"in your own field: off by {start:.2f} m, then {end:.4f} m")
