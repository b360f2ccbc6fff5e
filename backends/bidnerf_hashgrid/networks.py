"""The two networks of a field (Mueller et al. 2022, section 5.4), evaluated and differentiated in chunks of points on a CPU.

The hidden units of a whole batch take tens of megabytes. In chunks, they are computed, rectified and differentiated while
still in the cache, and no large blocks of memory need to be allocated and freed in each step. Chunks run on several threads. The
gradients of the weights are summed in the order of the chunks, so that they do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from bidnerf_hashgrid.threads import concurrently, slices, threads_for

NETWORK_CHUNK = 4096
"""Number of points whose hidden units stay in the cache of a core."""

Layers = list[tuple[Tensor, Tensor]]
"""Weights (out in) and biases (out) of linear layers with ReLUs between them."""


def log_density_and_rgb(
    geometry: nn.Sequential, colour: nn.Sequential, encoded: Float[Tensor, "n e"], harmonics: Float[Tensor, "n h"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Return the first output of ``geometry`` (log density), and the output of ``colour`` given the other outputs and ``harmonics``.

    Both networks are linear layers with ReLUs between them; ``colour`` ends with a sigmoid. On a CPU, the results cannot be
    differentiated twice.
    """
    if encoded.device.type != "cpu":
        features = geometry(encoded)
        return features[:, 0], colour(torch.cat([features[:, 1:], harmonics], dim=-1))
    parts = [list(network.parameters()) for network in (geometry, colour)]
    inputs = [encoded, harmonics, *parts[0], *parts[1]]
    differentiable = torch.is_grad_enabled() and any(part.requires_grad for part in inputs)
    output: tuple[Tensor, Tensor] = _Evaluate.apply(differentiable, len(parts[0]) // 2, *inputs)
    return output


def _networks(flat: Sequence[Tensor], geometry_layers: int) -> tuple[Layers, Layers]:
    """Group the flat weights and biases of both networks, or their gradients, into layers."""
    layers = list(zip(flat[::2], flat[1::2], strict=True))
    return layers[:geometry_layers], layers[geometry_layers:]


def _forward(x: Float[Tensor, "m i"], layers: Layers) -> tuple[list[Tensor], Float[Tensor, "m o"]]:
    """Return the inputs of all layers, and the output of the last layer."""
    inputs: list[Tensor] = []
    for weight, bias in layers:
        inputs.append(x.relu_() if inputs else x)
        x = torch.addmm(bias, x, weight.t())
    return inputs, x


def _backward(
    gradient: Float[Tensor, "m o"], inputs: list[Tensor], layers: Layers, to_layers: Layers | None
) -> Float[Tensor, "m i"]:
    """Return the gradient with respect to the first input, and write the layers' gradients to ``to_layers``."""
    for k in reversed(range(len(layers))):
        if to_layers is not None:
            torch.mm(gradient.t(), inputs[k], out=to_layers[k][0])
            torch.sum(gradient, 0, out=to_layers[k][1])
        gradient = gradient @ layers[k][0]
        if k:
            gradient = torch.ops.aten.threshold_backward(gradient, inputs[k], 0)
    return gradient


class _Evaluate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        differentiable: bool,
        geometry_layers: int,
        encoded: Float[Tensor, "n e"],
        harmonics: Float[Tensor, "n h"],
        *flat: Tensor,
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
        geometry, colour = _networks(flat, geometry_layers)
        chunks = slices(len(encoded), NETWORK_CHUNK)
        log_density, rgb = encoded.new_empty(len(encoded)), encoded.new_empty(len(encoded), 3)
        stored: list[list[Tensor]] = [[] for _ in chunks]

        def evaluate(chunk: slice, keep: list[Tensor]) -> None:
            of_geometry, features = _forward(encoded[chunk], geometry)
            of_colour, logits = _forward(torch.cat([features[:, 1:], harmonics[chunk]], dim=-1), colour)
            log_density[chunk], rgb[chunk] = features[:, 0], logits.sigmoid_()
            if differentiable:
                keep.extend([*of_geometry[1:], *of_colour])

        tasks = [partial(evaluate, chunk, keep) for chunk, keep in zip(chunks, stored, strict=True)]
        concurrently(tasks, threads_for(len(encoded), encoded.device))
        ctx.geometry_layers = geometry_layers
        ctx.save_for_backward(encoded, rgb, *flat, *(part for keep in stored for part in keep))
        return log_density, rgb

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, to_log_density: Float[Tensor, "n"], to_rgb: Float[Tensor, "n 3"]
    ) -> tuple[Tensor | None, ...]:
        _, _, wants_encoded, wants_harmonics, *wanted = ctx.needs_input_grad
        encoded, rgb, *rest = ctx.saved_tensors
        flat, inputs = rest[: len(wanted)], rest[len(wanted) :]
        geometry, colour = _networks(flat, ctx.geometry_layers)
        chunks, passed = slices(len(encoded), NETWORK_CHUNK), len(geometry[-1][1]) - 1
        each = len(inputs) // max(len(chunks), 1)
        width = colour[0][0].shape[1] - passed  # of the input that the geometry does not pass to the colour
        to_encoded = torch.empty_like(encoded) if wants_encoded else None
        to_harmonics = encoded.new_empty(len(encoded), width) if wants_harmonics else None
        sizes = [part.numel() for part in flat]
        # Gradients of all layers, one row per chunk.
        sums = encoded.new_empty(len(chunks), sum(sizes)) if any(wanted) else None

        def differentiate(number: int) -> None:
            own, at = inputs[number * each : (number + 1) * each], chunks[number]
            split = ctx.geometry_layers - 1
            to_geometry: Layers | None = None
            to_colour: Layers | None = None
            if sums is not None:
                rows = [row.view(part.shape) for row, part in zip(sums[number].split(sizes), flat, strict=True)]
                to_geometry, to_colour = _networks(rows, ctx.geometry_layers)
            gradient = _backward(to_rgb[at] * (rgb[at] * (1 - rgb[at])), own[split:], colour, to_colour)
            to_features = torch.cat([to_log_density[at, None], gradient[:, :passed]], dim=-1)
            gradients = _backward(to_features, [encoded[at], *own[:split]], geometry, to_geometry)
            for target, part in ((to_encoded, gradients), (to_harmonics, gradient[:, passed:])):
                if target is not None:
                    target[at] = part

        concurrently([partial(differentiate, k) for k in range(len(chunks))], threads_for(len(encoded), encoded.device))
        to_flat: Sequence[Tensor | None] = [None] * len(flat)
        if sums is not None:
            to_flat = [row.view(part.shape) for row, part in zip(sums.sum(0).split(sizes), flat, strict=True)]
        return None, None, to_encoded, to_harmonics, *to_flat
