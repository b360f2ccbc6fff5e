"""Triton kernels of the sampler: steps in occupied cells, and intervals concentrated where the cells are dense.

Each program handles one ray. See ``kernels`` for why kernels are used, and ``OccupancyGrid`` and ``Concentrated`` for the results.
"""

from __future__ import annotations

import triton
import triton.language as tl

# mypy: ignore-errors


@triton.jit
def _distance(coordinate, leave, radius, CONTRACTED: tl.constexpr):
    """Return the distance along a ray at a coordinate of ``RaySpacing``."""
    if CONTRACTED:
        beyond = tl.maximum(coordinate - leave, 0.0)
        left = tl.maximum(1 - beyond / radius, 1.1920929e-07)
        return tl.minimum(coordinate, leave) + beyond / left
    return coordinate


@triton.jit
def _coordinate(distance, leave, radius, CONTRACTED: tl.constexpr):
    """Return the coordinate of ``RaySpacing`` at a distance along a ray, the inverse of ``_distance``."""
    if CONTRACTED:
        beyond = tl.maximum(distance - leave, 0.0)
        return tl.minimum(distance, leave) + beyond / (1 + beyond / radius)
    return distance


@triton.jit
def _slab(o, d, middle, half):
    """Return the distances at which a line enters and leaves the slab of one axis from ``middle`` - ``half`` to ``middle`` + ``half``."""
    tiny = 1.1754943508222875e-38
    slope = 1 / tl.where(tl.abs(d) < tiny, tiny, d)
    a, b = (middle - half - o) * slope, (middle + half - o) * slope
    return tl.minimum(a, b), tl.maximum(a, b)


@triton.jit
def _limits(rays, grid, ray, n, CONTRACTED: tl.constexpr):
    """Return a ray's origin and direction, its limits in the coordinate of ``RaySpacing``, and where it leaves and enters the cube.

    ``rays`` are (8 n): origin, direction, near and far. ``grid`` holds the cube's centre, half its side, the step, and the number
    of cells along a side.
    """
    ox, oy, oz = tl.load(rays + ray), tl.load(rays + n + ray), tl.load(rays + 2 * n + ray)
    dx, dy, dz = tl.load(rays + 3 * n + ray), tl.load(rays + 4 * n + ray), tl.load(rays + 5 * n + ray)
    near, far = tl.load(rays + 6 * n + ray), tl.load(rays + 7 * n + ray)
    half = tl.load(grid + 3)
    ax, bx = _slab(ox, dx, tl.load(grid), half)
    ay, by = _slab(oy, dy, tl.load(grid + 1), half)
    az, bz = _slab(oz, dz, tl.load(grid + 2), half)
    enter = tl.maximum(tl.maximum(ax, ay), az)
    leave = tl.minimum(tl.minimum(bx, by), bz)
    leave = tl.where(leave > enter, tl.maximum(leave, 0.0), 0.0)
    near, far = _coordinate(near, leave, half, CONTRACTED), _coordinate(far, leave, half, CONTRACTED)
    return ox, oy, oz, dx, dy, dz, near, far, leave, enter


@triton.jit
def _cell_at(x, y, z, grid, CONTRACTED: tl.constexpr):
    """Return the index of the cell at (or nearest to) each point (world), and whether the point is inside the grid."""
    half, count = tl.load(grid + 3), tl.load(grid + 5)
    x, y, z = (x - tl.load(grid)) / half, (y - tl.load(grid + 1)) / half, (z - tl.load(grid + 2)) / half
    if CONTRACTED:
        norm = tl.maximum(tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z)), 1.0)
        shrink = (2 - 1 / norm) / norm / 2
        x, y, z = x * shrink, y * shrink, z * shrink
    inside = (tl.abs(x) <= 1) & (tl.abs(y) <= 1) & (tl.abs(z) <= 1)
    i = tl.minimum(tl.maximum((x + 1) * (count / 2), 0.0), count - 1).to(tl.int32)
    j = tl.minimum(tl.maximum((y + 1) * (count / 2), 0.0), count - 1).to(tl.int32)
    k = tl.minimum(tl.maximum((z + 1) * (count / 2), 0.0), count - 1).to(tl.int32)
    side = count.to(tl.int32)
    return (i * side + j) * side + k, inside


@triton.jit
def march_kernel(
    rays,
    grid,
    offset,
    occupied,
    middles,
    counts,
    n,
    STEPS: tl.constexpr,
    MOST: tl.constexpr,
    CONTRACTED: tl.constexpr,
    CHUNK: tl.constexpr,
):
    """Write the coordinates of the first ``MOST`` steps of each ray in occupied cells (r MOST), and how many there are.

    Each program handles one ray. ``counts`` may exceed ``MOST``; the farther steps are then not stored.
    """
    ray = tl.program_id(0)
    ox, oy, oz, dx, dy, dz, near, far, leave, enter = _limits(rays, grid, ray, n, CONTRACTED)
    step = tl.load(grid + 4)
    first = tl.load(offset + ray)
    if not CONTRACTED:  # steps are counted from ``near``, and those before the grid are skipped
        first += tl.maximum(tl.floor((tl.minimum(tl.maximum(enter, 0.0), 1e9) - near) / step), 0.0)
    count = 0
    last = ((far - near) / step).to(tl.int32) + 1
    if not CONTRACTED:
        last = tl.minimum(last, STEPS)
    for chunk in range(0, last, CHUNK):
        coordinate = near + (first + chunk + tl.arange(0, CHUNK)) * step
        distance = _distance(coordinate, leave, tl.load(grid + 3), CONTRACTED)
        cell, inside = _cell_at(ox + distance * dx, oy + distance * dy, oz + distance * dz, grid, CONTRACTED)
        inside = inside & (coordinate < far)
        matter = (tl.load(occupied + cell, mask=inside, other=0) != 0).to(tl.int32)
        at = count + tl.cumsum(matter, 0) - 1
        tl.store(middles + ray * MOST + at, coordinate, mask=(matter != 0) & (at < MOST))
        count += tl.sum(matter, 0)
    tl.store(counts + ray, count)


@triton.jit
def _interval(middles, at, count, near, far, leave, grid, MOST: tl.constexpr, CONTRACTED: tl.constexpr):
    """Return start and end (metres along the ray) of the one-step intervals around a ray's steps ``at``, and which exist."""
    step, radius = tl.load(grid + 4), tl.load(grid + 3)
    there = (at >= 0) & (at < count)
    coordinate = tl.load(middles + at, mask=there, other=0.0)
    start, end = tl.maximum(coordinate - step / 2, near), tl.minimum(coordinate + step / 2, far)
    if CONTRACTED:  # the remainder at the far end is short in the coordinate, but long in metres
        end = tl.where((at == count - 1) & (far - end < step), far, end)
    return _distance(start, leave, radius, CONTRACTED), _distance(end, leave, radius, CONTRACTED), there


@triton.jit
def _join(middles, at, count, near, far, leave, grid, MOST: tl.constexpr, CONTRACTED: tl.constexpr):
    """Return the result of ``_interval`` without the overlaps that rounding causes, see ``gathered``."""
    start, end, there = _interval(middles, at, count, near, far, leave, grid, MOST, CONTRACTED)
    following, _end, more = _interval(middles, at + 1, count, near, far, leave, grid, MOST, CONTRACTED)
    end = tl.where(more, tl.minimum(end, following), end)
    return start, tl.maximum(start, end), there


@triton.jit
def _absorb(start, end, there, ox, oy, oz, dx, dy, dz, grid, density, thickest, CONTRACTED: tl.constexpr):
    """Return the optical thickness of intervals according to the grid's densities, limited to ``thickest``."""
    middle = (start + end) / 2
    cell, _inside = _cell_at(ox + middle * dx, oy + middle * dy, oz + middle * dz, grid, CONTRACTED)
    thickness = tl.load(density + cell, mask=there, other=0.0) * (end - start)
    return tl.where(there, tl.minimum(thickness, thickest), 0.0)


@triton.jit
def _neighbour(values, by, J: tl.constexpr):
    """Return, for each element, the value that is ``by`` elements later, or 0 if there is none."""
    here, other = tl.arange(0, J)[:, None], tl.arange(0, J)[None, :]
    return tl.sum(tl.where(other == here + by, values[None, :], 0.0), 1)


@triton.jit
def concentrate_kernel(
    rays,
    grid,
    middles,
    counts,
    density,
    shift,
    starts,
    ends,
    valid,
    n,
    thickest,
    tail,
    COUNT: tl.constexpr,
    EVEN: tl.constexpr,
    MOST: tl.constexpr,
    S: tl.constexpr,
    J: tl.constexpr,
    CONTRACTED: tl.constexpr,
):
    """Write ``COUNT`` intervals of each ray (r COUNT), concentrated where ``density`` gives large weights, see ``Concentrated``.

    ``shift`` (r COUNT + 1) is added to the levels of the borders: first those by weight, then ``EVEN`` by length. Each program
    handles one ray.
    """
    ray = tl.program_id(0).to(tl.int64)
    ox, oy, oz, dx, dy, dz, near, far, leave, _enter = _limits(rays, grid, ray, n, CONTRACTED)
    count = tl.minimum(tl.load(counts + ray), MOST)
    middles += ray * MOST
    j = tl.arange(0, J)
    stored = j < COUNT
    out = ray * COUNT + j
    if count <= COUNT:
        own_start, own_end, own = _join(middles, j, count, near, far, leave, grid, MOST, CONTRACTED)
        last = _distance(far, leave, tl.load(grid + 3), CONTRACTED)
        tl.store(starts + out, tl.where(own, own_start, last), mask=stored)
        tl.store(ends + out, tl.where(own, own_end, last), mask=stored)
        tl.store(valid + out, own, mask=stored)
    else:
        i = tl.arange(0, S)
        start, end, there = _join(middles, i, count, near, far, leave, grid, MOST, CONTRACTED)
        thickness = _absorb(start, end, there, ox, oy, oz, dx, dy, dz, grid, density, thickest, CONTRACTED)
        a, b, there_a = _join(middles, i - 1, count, near, far, leave, grid, MOST, CONTRACTED)
        before_own = _absorb(a, b, there_a, ox, oy, oz, dx, dy, dz, grid, density, thickest, CONTRACTED)
        a, b, there_b = _join(middles, i + 1, count, near, far, leave, grid, MOST, CONTRACTED)
        behind_own = _absorb(a, b, there_b, ox, oy, oz, dx, dy, dz, grid, density, thickest, CONTRACTED)
        passed = tl.cumsum(thickness, 0)
        weight = tl.exp(thickness - passed) * (1 - tl.exp(-thickness))
        weight = tl.maximum(weight, tl.exp(thickness - passed + before_own) * (1 - tl.exp(-before_own)))
        weight = tl.maximum(weight, tl.exp(-passed) * (1 - tl.exp(-behind_own)))
        length = tl.where(there, end - start, 0.0)
        laid = tl.cumsum(length, 0)
        total = tl.sum(length, 0)
        mass = tl.where(length > 0, weight, 0.0) + 1e-5 * length / tl.maximum(total, 1e-30)
        share = tl.cumsum(mass, 0) / tl.maximum(tl.sum(mass, 0), 1e-30)

        # Borders by weight, where the share passes their levels, then by length.
        by_weight: tl.constexpr = COUNT + 1 - EVEN
        level = tl.where(j < by_weight, j / (by_weight - 1.0 + (by_weight == 1)), (j - by_weight) / (EVEN - 1.0))
        level += tl.load(shift + ray * (COUNT + 1) + j, mask=j <= COUNT, other=0.0)
        dense = (tail + (1 - 2 * tail) * level)[None, :]
        below = share[:, None] <= dense
        x0 = tl.max(tl.where(below, share[:, None], 0.0), 0)
        y0 = tl.max(tl.where(below, laid[:, None], 0.0), 0)
        x1 = tl.min(tl.where(below, 1.0, share[:, None]), 0)
        y1 = tl.min(tl.where(below, total, laid[:, None]), 0)
        between = y0 + (tail + (1 - 2 * tail) * level - x0) * (y1 - y0) / tl.maximum(x1 - x0, 1.1754943508222875e-38)
        border = tl.where(j < by_weight, tl.minimum(tl.maximum(between, y0), y1), level * total)
        border = tl.sort(tl.where(j <= COUNT, border, float("inf")))

        following = _neighbour(border, 1, J)
        middle = tl.where(stored, (border + following) / 2, 0.0)
        half = tl.where(stored, (following - border) / 2, 0.0)
        behind = laid[:, None] < middle[None, :]
        owner = tl.minimum(tl.sum(behind.to(tl.int32), 0), count - 1)
        mine = i[:, None] == owner[None, :]
        at = tl.sum(tl.where(mine, (start - laid + length)[:, None], 0.0), 0) + middle
        lower, upper = at - half, at + half
        # Neither rounding nor an interval that spans a gap may make two of them overlap.
        joint = (_neighbour(upper, -1, J) + lower) / 2
        halfway = (upper + _neighbour(lower, 1, J)) / 2
        lower = tl.where(j > 0, tl.maximum(lower, joint), lower)
        upper = tl.maximum(lower, tl.where(j < COUNT - 1, tl.minimum(upper, halfway), upper))
        tl.store(starts + out, lower, mask=stored)
        tl.store(ends + out, upper, mask=stored)
        tl.store(valid + out, half > 0, mask=stored)
