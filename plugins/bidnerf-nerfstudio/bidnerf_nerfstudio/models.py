"""Reading nerfstudio models: the settings of the corresponding field here, and its tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bidnerf_core.io import Record
from bidnerf_nerfstudio.instant_ngp import NgpConfig
from bidnerf_nerfstudio.nerfacto import NerfactoConfig
from bidnerf_nerfstudio.networks import HashConfig
from bidnerf_nerfstudio.vanilla import DIRECTION, POSITION, VanillaConfig, reordered
from bidnerf_nerfstudio.weights import Weights, layer_names, mean_code


@dataclass(frozen=True, eq=False)
class Read:
    """The result of reading a model."""

    settings: Any  # of the backend, without placement and steps
    state: dict[str, Tensor]
    box: tuple[float, ...]  # corners of the scene in training coordinates
    contracted: bool
    told: str


def nerfacto(weights: Weights, model: Record, parser: Record) -> Read:
    """Read a nerfacto run. Raises ``InputError`` if its tensors are inconsistent."""
    radiance, state, box = _radiance(weights, model, bool(model.value("use_average_appearance_embedding")))
    count = int(model.number("num_proposal_iterations") or 2)
    options = model.items("proposal_net_args_list") or [{}]
    same = bool(model.value("use_same_proposal_network"))
    proposals = []
    for number in range(count):
        own = options[min(number, len(options) - 1)]
        base = Record(f"{model.where}: proposal_net_args_list", own if isinstance(own, dict) else {})
        proposal, tensors = _proposal(weights, 0 if same else number, int(base.number("base_res") or 16), number)
        proposals.append(proposal)
        state |= tensors
    samples = model.value("num_proposal_samples_per_ray")
    counts = tuple(int(each) for each in samples)[:count] if isinstance(samples, list | tuple) else (256, 96)
    uniform = model.text("proposal_initial_sampler") == "uniform"
    settings = NerfactoConfig(
        **radiance,
        proposals=tuple(proposals),
        proposal_samples=counts,
        samples=int(model.number("num_nerf_samples_per_ray") or 48),
        spacing="uniform" if uniform else "piecewise",
    )
    contracted = not model.value("disable_scene_contraction")
    told = (
        f"{settings.encoding.levels} levels of 2^{settings.encoding.log2_table_size} entries, {count} proposal networks"
    )
    return Read(settings, state, box, contracted, told)


def _radiance(
    weights: Weights, model: Record, mean: bool
) -> tuple[dict[str, Any], dict[str, Tensor], tuple[float, ...]]:
    """Return the settings, tensors and box of nerfstudio's NerfactoField."""
    base, table = _base(weights)
    layers, head = weights.layers(base), weights.layers("field.mlp_head.")
    # Versions before 1.0 did not have the setting, and always used 16.
    encoding = weights.hash_config("field.", table, layers, int(model.number("base_res") or 16))
    geometry = weights.shape(f"{layers[-1]}weight", 2)[0] - 1
    code = torch.zeros(0)
    if "field.embedding_appearance.embedding.weight" in weights.tensors:
        code = mean_code(weights, "field.embedding_appearance.embedding.weight", mean)
    names = {"radiance.base.encoding.table": table}
    names |= layer_names("radiance.base.head.", layers) | layer_names("radiance.head.", head)
    box = weights.get("field.aabb")
    if tuple(box.shape) != (2, 3):
        raise weights.error(f"'field.aabb' is {tuple(box.shape)}", expected="(2, 3)")
    corners = tuple(box.reshape(-1).tolist())
    settings = {
        "encoding": encoding,
        "geometry_features": geometry,
        "colour_layers": len(head),
        "colour_width": weights.shape(f"{head[0]}weight", 2)[0],
        "appearance": len(code),
        "box": corners,
        "initial_density": model.number("average_init_density") or 1.0,
    }
    return settings, weights.renamed(names) | {"radiance.appearance": code}, corners


def _base(weights: Weights) -> tuple[str, str]:
    """Return the name prefixes of the layers and of the table; versions before 1.1 have no "model" in them."""
    for begin in ("field.mlp_base.model.", "field.mlp_base."):
        if f"{begin}0.hash_table" in weights.tensors:
            return f"{begin}1.", f"{begin}0.hash_table"
    raise weights.error(
        "no 'field.mlp_base.model.0.hash_table'", expected="a checkpoint of the model that the config names"
    )


def _proposal(weights: Weights, number: int, base: int, place: int) -> tuple[HashConfig, dict[str, Tensor]]:
    """Return the sizes and tensors of a proposal network, renamed to those at ``place``."""
    begin, ours = f"proposal_networks.{number}.", f"proposals.{place}.network."
    table = f"{begin}encoding.hash_table"
    linear = f"{begin}linear.weight" in weights.tensors
    layers = [f"{begin}linear."] if linear else weights.layers(f"{begin}mlp_base.1.")
    names = {f"{ours}encoding.table": table} | layer_names(f"{ours}head.", layers)
    return weights.hash_config(begin, table, layers, base), weights.renamed(names)


def instant_ngp(weights: Weights, model: Record, parser: Record) -> Read:
    """Read an instant-ngp run. Raises ``InputError`` if its tensors are inconsistent."""
    radiance, state, box = _radiance(weights, model, mean=False)
    cells = weights.get("occupancy_grid.binaries")
    if cells.dim() != 4 or len({*cells.shape[1:]}) != 1:
        raise weights.error(f"'occupancy_grid.binaries' is {tuple(cells.shape)}", expected="cubes of cells")
    radiance["initial_density"] = 1.0  # this model does not set it
    side = [high - low for low, high in zip(box[:3], box[3:], strict=True)]
    step = model.number("render_step_size") or sum(s * s for s in side) ** 0.5 / 1000
    settings = NgpConfig(
        **radiance,
        grid_levels=cells.shape[0],
        grid_resolution=cells.shape[1],
        step=step,
        cone_angle=model.number("cone_angle") or 0.0,
    )
    state |= {"grid.cells": cells.bool(), "grid.peak": torch.zeros_like(cells)}
    share = float(cells.bool().float().mean())
    told = f"{share:.1%} of {cells.shape[0]} x {cells.shape[1]}^3 cells are occupied"
    return Read(settings, state, box, not model.value("disable_scene_contraction"), told)


def vanilla(weights: Weights, model: Record, parser: Record) -> Read:
    """Read a vanilla-nerf run. Raises ``InputError`` if its tensors are inconsistent."""
    if model.value("enable_temporal_distortion"):
        raise weights.error("a dynamic scene (enable_temporal_distortion)", expected="a static one")
    names: dict[str, str] = {}
    for ours, theirs in (("coarse", "field_coarse"), ("fine", "field_fine")):
        begin = f"{ours}.network."
        names |= layer_names(f"{begin}base.", weights.layers(f"{theirs}.mlp_base."))
        names |= layer_names(f"{begin}head.", weights.layers(f"{theirs}.mlp_head."))
        names |= {f"{begin}density.{part}": f"{theirs}.field_output_density.net.{part}" for part in ("weight", "bias")}
        names |= {f"{begin}colour.{part}": f"{theirs}.field_heads.0.net.{part}" for part in ("weight", "bias")}
    state = weights.renamed(names)
    base, head = weights.layers("field_fine.mlp_base."), weights.layers("field_fine.mlp_head.")
    settings = VanillaConfig(
        width=weights.shape(f"{base[0]}weight", 2)[0],
        layers=len(base),
        colour_width=weights.shape(f"{head[0]}weight", 2)[0],
        colour_layers=len(head),
        coarse_samples=int(model.number("num_coarse_samples") or 64),
        fine_samples=int(model.number("num_importance_samples") or 128) + 1,
    )
    for ours in ("coarse", "fine"):
        for layer, count in (
            ("base.layers.0", POSITION),
            ("base.layers.4", POSITION),
            ("head.layers.0", DIRECTION),
        ):
            name = f"{ours}.network.{layer}.weight"
            if name in state:
                state[name] = reordered(state[name], count, weights)
    half = parser.number("scene_scale")
    if half is None:
        half = 1.5  # of the side of the box that nerfstudio assumes for Blender scenes
    told = f"coarse and fine network of {settings.layers} layers of {settings.width}"
    return Read(settings, state, (-half, -half, -half, half, half, half), False, told)
