"""Checks of ``RadianceField.query``: shapes, ranges, and that values depend only on the query."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor

from bidnerf_core.fields import FieldValues, RadianceField
from bidnerf_core.testing.faults import query, require_that
from bidnerf_core.testing.scene import awkward_points, points

SHAPES = ((), (7,), (1,), (2, 3), (2, 1, 3), (0,), (2, 0), (0, 3))


def check_shapes(field: RadianceField) -> None:
    """Check any leading axes, including empty ones, and that values do not depend on the points' arrangement."""
    positions, directions = points(7)
    flat = stacked(query(field, positions, directions, "7 points"))
    for shape in SHAPES:
        count = torch.Size(shape).numel()
        places, towards = (x[:count].reshape(*shape, 3) for x in (positions, directions))
        values = stacked(query(field, places, towards, f"points arranged as {shape}"))
        require_that(
            close(values.reshape(-1, 4), flat[:count]),
            f"{type(field).__name__}.query: points arranged as {shape} have other values than the same points in"
            " one row; expected each point's value to depend on that point alone",
        )


def check_ranges(field: RadianceField) -> None:
    """Check that values are finite everywhere, density >= 0 and rgb in [0, 1]."""
    for of, positions in awkward_points().items():
        directions = points(len(positions), seed=1)[1]
        values = query(field, positions, directions, of)
        who = f"{type(field).__name__}.query of {of}"
        for what, found in (("density", values.density), ("rgb", values.rgb)):
            require_that(
                bool(found.isfinite().all()), f"{who}: {what} is NaN or infinite, expected finite numbers"
            )
        low, high = float(values.rgb.min()), float(values.rgb.max())
        least = float(values.density.min())
        require_that(
            least >= 0, f"{who}: density is {least:g}, expected 0 or more; end with softplus, relu or exp"
        )
        require_that(
            low >= 0 and high <= 1,
            f"{who}: rgb is from {low:g} to {high:g}, expected 0 to 1; end with a sigmoid",
        )


def check_precision(field: RadianceField, doubled: RadianceField) -> None:
    """Check that ``doubled``, a copy of ``field`` in float64, computes the same values in that precision."""
    positions, directions = points(64)
    expected = query(field, positions, directions, "points in float32")
    found = query(doubled, positions.double(), directions.double(), "points in float64, after .double()")
    for what in ("density", "rgb"):
        single, double = getattr(expected, what), getattr(found, what)
        who = f"{type(field).__name__}.query after .double(): {what}"
        require_that(
            single.dtype == torch.float32,
            f"{type(field).__name__}.query: {what} is {single.dtype} for points in float32, expected float32",
        )
        require_that(
            double.dtype == torch.float64,
            f"{who} is {double.dtype}, expected float64; make constants with positions.new_tensor or as buffers",
        )
        require_that(
            close(double.float(), single, 1e-2),
            f"{who} is another than in float32, expected the same to rounding",
        )


def check_threads(field: RadianceField) -> None:
    """Check that concurrent queries return the same values as a single one."""
    parts = [points(200 + 31 * i, seed=i) for i in range(4)]
    alone = [stacked(query(field, *part, "points")) for part in parts]

    def ask(number: int) -> Tensor:
        part = parts[number % 4]
        return stacked(query(field, *part, "points, by several threads at once"))

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(ask, range(32)))
    require_that(
        all(close(answer, alone[i % 4]) for i, answer in enumerate(answers)),
        f"{type(field).__name__}.query: concurrent threads get different values from a single one; expected"
        " query to store nothing on self",
    )


def stacked(values: FieldValues) -> Tensor:
    """Return density and colour as four channels (*p 4)."""
    return torch.cat([values.density[..., None], values.rgb], dim=-1).detach()


def close(found: Tensor, expected: Tensor, tolerance: float = 1e-4) -> bool:
    """Return whether values are equal up to rounding, relative to the largest value of each channel."""
    if expected.numel() == 0:
        return found.shape == expected.shape
    scale = expected.abs().reshape(-1, expected.shape[-1]).amax(0).clamp(min=1e-6)
    return bool(((found - expected).abs() <= tolerance * scale).all())
