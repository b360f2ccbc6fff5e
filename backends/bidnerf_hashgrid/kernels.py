"""Triton kernels for a GPU: the encoding with its derivatives, the whole field with its derivatives, and the sampler.

On a GPU, the pure-torch path takes hundreds of launches, each of which takes longer to start than to compute. Each kernel here
does in one launch what dozens of operations do there; the torch path is the reference that they are tested against, on a CPU by
Triton's interpreter. Triton comes with torch's CUDA build. A tile is (points, columns), where a column is a feature of a level.
"""

from __future__ import annotations

import triton
import triton.language as tl

# mypy: ignore-errors


@triton.jit
def _cells(x, y, z, resolution, entries, hashed, stride_y, stride_z):
    """Return the lower corner's index terms along each axis, the strides to the upper ones, and the position in the cell."""
    last = resolution - 1
    size = resolution.to(tl.float32)
    sx, sy, sz = x * size, y * size, z * size
    lx = tl.minimum(tl.maximum(sx.to(tl.int32), 0), last)
    ly = tl.minimum(tl.maximum(sy.to(tl.int32), 0), last)
    lz = tl.minimum(tl.maximum(sz.to(tl.int32), 0), last)
    return (
        lx,
        ly * stride_y,
        lz * stride_z,
        sx - lx.to(tl.float32),
        sy - ly.to(tl.float32),
        sz - lz.to(tl.float32),
    )


@triton.jit
def _index(tx, ty, tz, entries, hashed):
    """Return the table index of a vertex (Mueller et al. 2022, eq. 4 if hashed, else dense)."""
    return tl.where(hashed > 0, (tx ^ ty ^ tz) & (entries - 1), tx + ty + tz)


@triton.jit
def _weight(f, SMOOTH: tl.constexpr):
    """Return the weight of the upper vertex, and its derivative, at a position in a cell."""
    if SMOOTH:
        weight = f * f * (3 - 2 * f)
        slope = 6 * f * (1 - f)
    else:
        weight = f
        slope = tl.full(f.shape, 1.0, tl.float32)
    return weight, slope


@triton.jit
def _columns(meta, tables, offsets, LEVELS: tl.constexpr, F: tl.constexpr, C: tl.constexpr):
    """Return each column's table, and its level's constants, as rows of tiles; columns beyond the levels are not valid."""
    column = tl.arange(0, C)
    level = tl.minimum(column // F, LEVELS - 1)
    table = (tables + tl.load(offsets + level) + column % F)[None, :]
    resolution = tl.load(meta + level)[None, :]
    entries = tl.load(meta + LEVELS + level)[None, :]
    hashed = tl.load(meta + 2 * LEVELS + level)[None, :]
    stride_y = tl.load(meta + 3 * LEVELS + level)[None, :]
    stride_z = tl.load(meta + 4 * LEVELS + level)[None, :]
    return table, resolution, entries, hashed, stride_y, stride_z, (column < LEVELS * F)[None, :]


@triton.jit
def _encoded(
    x, y, z, inside, table, resolution, entries, hashed, stride_y, stride_z, F: tl.constexpr, SMOOTH: tl.constexpr
):  # fmt: skip
    """Return the features at positions (points, 1) in the unit cube, and their derivatives by x, y and z: eight reads a column."""
    tx, ty, tz, fx, fy, fz = _cells(x, y, z, resolution, entries, hashed, stride_y, stride_z)
    wx, dx = _weight(fx, SMOOTH)
    wy, dy = _weight(fy, SMOOTH)
    wz, dz = _weight(fz, SMOOTH)
    c000 = tl.load(table + F * _index(tx, ty, tz, entries, hashed), mask=inside, other=0.0)
    c100 = tl.load(table + F * _index(tx + 1, ty, tz, entries, hashed), mask=inside, other=0.0)
    c010 = tl.load(table + F * _index(tx, ty + stride_y, tz, entries, hashed), mask=inside, other=0.0)
    c110 = tl.load(table + F * _index(tx + 1, ty + stride_y, tz, entries, hashed), mask=inside, other=0.0)
    c001 = tl.load(table + F * _index(tx, ty, tz + stride_z, entries, hashed), mask=inside, other=0.0)
    c101 = tl.load(table + F * _index(tx + 1, ty, tz + stride_z, entries, hashed), mask=inside, other=0.0)
    c011 = tl.load(
        table + F * _index(tx, ty + stride_y, tz + stride_z, entries, hashed), mask=inside, other=0.0
    )
    c111 = tl.load(
        table + F * _index(tx + 1, ty + stride_y, tz + stride_z, entries, hashed), mask=inside, other=0.0
    )
    # Interpolated along z, then y, then x, with the differences that give the derivatives.
    z00, z10, z01, z11 = c001 - c000, c101 - c100, c011 - c010, c111 - c110
    a00, a10 = c000 + wz * z00, c100 + wz * z10
    a01, a11 = c010 + wz * z01, c110 + wz * z11
    y0, y1 = a01 - a00, a11 - a10
    b0, b1 = a00 + wy * y0, a10 + wy * y1
    by_x = b1 - b0
    by_y = y0 + wx * (y1 - y0)
    e0, e1 = z00 + wy * (z01 - z00), z10 + wy * (z11 - z10)
    by_z = e0 + wx * (e1 - e0)
    size = resolution.to(tl.float32)
    return b0 + wx * by_x, by_x * dx * size, by_y * dy * size, by_z * dz * size


@triton.jit
def encode_kernel(
    points, values, slopes, meta, tables, offsets, n, width,
    LEVELS: tl.constexpr, F: tl.constexpr, C: tl.constexpr, SMOOTH: tl.constexpr, SLOPES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Encode points (3 n): values (n width) and, with ``SLOPES``, derivatives (3 n width)."""
    row = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK))[:, None]
    there = row < n
    x = tl.load(points + row, mask=there, other=0.0)
    y = tl.load(points + n + row, mask=there, other=0.0)
    z = tl.load(points + 2 * n + row, mask=there, other=0.0)
    table, resolution, entries, hashed, stride_y, stride_z, used = _columns(
        meta, tables, offsets, LEVELS, F, C
    )
    value, by_x, by_y, by_z = _encoded(
        x, y, z, there & used, table, resolution, entries, hashed, stride_y, stride_z, F, SMOOTH
    )
    at = row.to(tl.int64) * width + tl.arange(0, C)[None, :]
    stored = there & (tl.arange(0, C)[None, :] < width)
    tl.store(values + at, value, mask=stored)
    if SLOPES:
        area = n.to(tl.int64) * width
        tl.store(slopes + at, by_x, mask=stored)
        tl.store(slopes + area + at, by_y, mask=stored)
        tl.store(slopes + 2 * area + at, by_z, mask=stored)


@triton.jit
def scatter_kernel(
    points, gradient, meta, tables, offsets, n, width,
    LEVELS: tl.constexpr, F: tl.constexpr, C: tl.constexpr, SMOOTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add the gradient (n width) of the encoding to the tables' gradients: the transpose of ``encode_kernel``."""
    row = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK))[:, None]
    there = row < n
    x = tl.load(points + row, mask=there, other=0.0)
    y = tl.load(points + n + row, mask=there, other=0.0)
    z = tl.load(points + 2 * n + row, mask=there, other=0.0)
    table, resolution, entries, hashed, stride_y, stride_z, used = _columns(
        meta, tables, offsets, LEVELS, F, C
    )
    inside = there & used
    pull = tl.load(gradient + row.to(tl.int64) * width + tl.arange(0, C)[None, :], mask=inside, other=0.0)
    inside = inside & (pull != 0)  # most samples are padding or lie in empty space
    tx, ty, tz, fx, fy, fz = _cells(x, y, z, resolution, entries, hashed, stride_y, stride_z)
    wx, _x = _weight(fx, SMOOTH)
    wy, _y = _weight(fy, SMOOTH)
    wz, _z = _weight(fz, SMOOTH)
    for corner in tl.static_range(8):
        ux = tx + (corner & 1)
        uy = ty + ((corner >> 1) & 1) * stride_y
        uz = tz + (corner >> 2) * stride_z
        share = pull
        share *= wx if corner & 1 else 1 - wx
        share *= wy if (corner >> 1) & 1 else 1 - wy
        share *= wz if corner >> 2 else 1 - wz
        tl.atomic_add(table + F * _index(ux, uy, uz, entries, hashed), share, mask=inside, sem="relaxed")


@triton.jit
def _harmonics(x, y, z, column):
    """Return the nine real spherical harmonics of unit directions (points, 1) in columns 0 to 8, and 0 in the others."""
    found = tl.where(column == 0, 0.28209479177387814, 0.0)
    found = tl.where(column == 1, 0.4886025119029199 * y, found)
    found = tl.where(column == 2, 0.4886025119029199 * z, found)
    found = tl.where(column == 3, 0.4886025119029199 * x, found)
    found = tl.where(column == 4, 1.0925484305920792 * x * y, found)
    found = tl.where(column == 5, 1.0925484305920792 * y * z, found)
    found = tl.where(column == 6, 0.31539156525252005 * (3 * z * z - 1), found)
    found = tl.where(column == 7, 1.0925484305920792 * x * z, found)
    return tl.where(column == 8, 0.5462742152960396 * (x * x - y * y), found)


@triton.jit
def _harmonics_along(x, y, z, column, AXIS: tl.constexpr):
    """Return the derivatives of ``_harmonics`` by x (``AXIS`` 0), y or z."""
    a, b, c, d = 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
    if AXIS == 0:
        found = tl.where(column == 3, a, 0.0)
        found = tl.where(column == 4, b * y, found)
        found = tl.where(column == 7, b * z, found)
        return tl.where(column == 8, 2 * d * x, found)
    if AXIS == 1:
        found = tl.where(column == 1, a, 0.0)
        found = tl.where(column == 4, b * x, found)
        found = tl.where(column == 5, b * z, found)
        return tl.where(column == 8, -2 * d * y, found)
    found = tl.where(column == 2, a, 0.0)
    found = tl.where(column == 5, b * y, found)
    found = tl.where(column == 6, 6 * c * z, found)
    return tl.where(column == 7, b * x, found)


@triton.jit
def _tile(start, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    return tl.load(start + tl.arange(0, ROWS)[:, None] * COLUMNS + tl.arange(0, COLUMNS)[None, :])


@triton.jit
def _colour_layers(start, WIDTH: tl.constexpr, FEATURES: tl.constexpr, HIDDEN: tl.constexpr):
    """Return where the weights of the colour network begin: of the features, the harmonics, hidden layers, and the output."""
    of_harmonics = start + FEATURES * WIDTH
    of_hidden = of_harmonics + 16 * WIDTH
    return start, of_harmonics, of_hidden, of_hidden + HIDDEN * WIDTH * WIDTH


@triton.jit
def _colour_tangent(
    tangent, first, second, weights, WIDTH: tl.constexpr, HIDDEN: tl.constexpr, PRECISION: tl.constexpr
):
    """Carry the tangent (points, WIDTH) of the first hidden layer's inputs on to the logits."""
    tangent = tl.where(first, tangent, 0.0)
    if HIDDEN:
        tangent = tl.dot(tangent, _tile(weights, WIDTH, WIDTH), input_precision=PRECISION)
        tangent = tl.where(second, tangent, 0.0)
    return tl.dot(tangent, _tile(weights + HIDDEN * WIDTH * WIDTH, WIDTH, 16), input_precision=PRECISION)


@triton.jit
def field_kernel(
    positions, directions, values, derivatives, index, count, meta, tables, offsets, weights, biases, box, n,
    LEVELS: tl.constexpr, F: tl.constexpr, C: tl.constexpr, WIDTH: tl.constexpr, FEATURES: tl.constexpr, HIDDEN: tl.constexpr,
    SMOOTH: tl.constexpr, CONTRACTED: tl.constexpr, LIMIT: tl.constexpr, DERIVATIVES: tl.constexpr, SOME: tl.constexpr,
    BLOCK: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Compute density and colour (n 4) at points (n 3, world) along directions (n 3) and, with ``DERIVATIVES``, (n 4 6).

    Derivatives by position (three) and by direction (three) are carried forward with the values. ``box`` has the scene's centre,
    the factor to the cube [-1, 1] and the factor of the density. Layers are padded with zeros to ``WIDTH`` and ``FEATURES``, whose
    first column is the log density; ``weights`` has them one after the other, each (inputs, outputs). With ``SOME``, only the
    first ``count`` points of ``index`` are computed.
    """
    row = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK))[:, None]
    if SOME:
        n = tl.load(count)
        if tl.program_id(0) * BLOCK >= n:
            return
    there = row < n
    far = tl.load(index + row, mask=there, other=0) if SOME else row.to(tl.int64)
    scale = tl.load(box + 3)
    px = (tl.load(positions + 3 * far, mask=there, other=0.0) - tl.load(box)) * scale
    py = (tl.load(positions + 3 * far + 1, mask=there, other=0.0) - tl.load(box + 1)) * scale
    pz = (tl.load(positions + 3 * far + 2, mask=there, other=0.0) - tl.load(box + 2)) * scale
    norm = tl.maximum(tl.maximum(tl.abs(px), tl.abs(py)), tl.abs(pz))
    if CONTRACTED:
        outside = norm > 1
        norm = tl.maximum(norm, 1.0)
        shrink = (2 - 1 / norm) / norm / 2
    else:
        outside = norm < 0
        shrink = tl.full(norm.shape, 1.0, tl.float32)
    ux, uy, uz = (px * shrink + 1) / 2, (py * shrink + 1) / 2, (pz * shrink + 1) / 2
    table, resolution, entries, hashed, stride_y, stride_z, used = _columns(
        meta, tables, offsets, LEVELS, F, C
    )
    x = tl.minimum(tl.maximum(ux, 0.0), 1.0)
    y = tl.minimum(tl.maximum(uy, 0.0), 1.0)
    z = tl.minimum(tl.maximum(uz, 0.0), 1.0)
    encoded, by_x, by_y, by_z = _encoded(
        x, y, z, there & used, table, resolution, entries, hashed, stride_y, stride_z, F, SMOOTH
    )
    column = tl.arange(0, 16)[None, :]
    dx = tl.load(directions + 3 * far, mask=there, other=0.0)
    dy = tl.load(directions + 3 * far + 1, mask=there, other=0.0)
    dz = tl.load(directions + 3 * far + 2, mask=there, other=0.0)

    into, out_of = weights, weights + C * WIDTH
    of_features, of_harmonics, of_hidden, of_logits = _colour_layers(
        out_of + WIDTH * FEATURES, WIDTH, FEATURES, HIDDEN
    )
    hidden = tl.dot(encoded, _tile(into, C, WIDTH), input_precision="tf32x3")
    hidden += tl.load(biases + tl.arange(0, WIDTH))[None, :]
    geometry = hidden > 0
    features = tl.dot(tl.maximum(hidden, 0.0), _tile(out_of, WIDTH, FEATURES), input_precision="tf32x3")
    features += tl.load(biases + WIDTH + tl.arange(0, FEATURES))[None, :]
    biases += WIDTH + FEATURES
    units = tl.dot(features, _tile(of_features, FEATURES, WIDTH), input_precision="tf32x3")
    units += tl.dot(_harmonics(dx, dy, dz, column), _tile(of_harmonics, 16, WIDTH), input_precision="tf32x3")
    units += tl.load(biases + tl.arange(0, WIDTH))[None, :]
    first = units > 0
    units = tl.maximum(units, 0.0)
    second = first
    if HIDDEN:
        units = tl.dot(units, _tile(of_hidden, WIDTH, WIDTH), input_precision="tf32x3")
        units += tl.load(biases + WIDTH + tl.arange(0, WIDTH))[None, :]
        second = units > 0
        units = tl.maximum(units, 0.0)
    logits = tl.dot(units, _tile(of_logits, WIDTH, 16), input_precision="tf32x3")
    logits += tl.load(biases + (1 + HIDDEN) * WIDTH + tl.arange(0, 16))[None, :]
    rgb = 1 / (1 + tl.exp(-logits))

    feature = tl.arange(0, FEATURES)[None, :]
    log_density = tl.sum(tl.where(feature == 0, features, 0.0), 1)[:, None]
    density = tl.exp(tl.minimum(log_density, LIMIT)) * tl.load(box + 4)
    tl.store(values + 4 * far, density, mask=there)
    tl.store(values + 4 * far + 1 + column, rgb, mask=there & (column < 3))
    if DERIVATIVES:
        steep = tl.where(log_density <= LIMIT, density, 0.0)
        sigmoid = rgb * (1 - rgb)
        # A coordinate beyond the cube is clamped to it, and has no derivative.
        by_x = tl.where((ux >= 0) & (ux <= 1), by_x, 0.0)
        by_y = tl.where((uy >= 0) & (uy <= 1), by_y, 0.0)
        by_z = tl.where((uz >= 0) & (uz <= 1), by_z, 0.0)
        along = by_x * px + by_y * py + by_z * pz
        # d(p g) / dp = g I + p (grad g)^T, where g depends on the largest coordinate only.
        turn = tl.where(outside, (1 / norm - 1) / (norm * norm), 0.0)
        for axis in tl.static_range(6):
            if axis < 3:
                by_axis = by_x if axis == 0 else by_y if axis == 1 else by_z
                if CONTRACTED:
                    mine = px if axis == 0 else py if axis == 1 else pz
                    largest = outside & (tl.abs(mine) == norm)
                    by_axis = by_axis * shrink + along * tl.where(
                        largest, turn * tl.where(mine > 0, 1.0, -1.0), 0.0
                    )
                by_axis = by_axis * (scale / 2)
                tangent = tl.dot(by_axis, _tile(into, C, WIDTH), input_precision=PRECISION)
                tangent = tl.where(geometry, tangent, 0.0)
                tangent = tl.dot(tangent, _tile(out_of, WIDTH, FEATURES), input_precision=PRECISION)
                by_log = tl.sum(tl.where(feature == 0, tangent, 0.0), 1)[:, None]
                tl.store(derivatives + 24 * far + axis, steep * by_log, mask=there)
                tangent = tl.dot(tangent, _tile(of_features, FEATURES, WIDTH), input_precision=PRECISION)
            else:
                tl.store(derivatives + 24 * far + axis, tl.zeros_like(density), mask=there)
                turned = _harmonics_along(dx, dy, dz, column, axis - 3)
                tangent = tl.dot(turned, _tile(of_harmonics, 16, WIDTH), input_precision=PRECISION)
            tangent = _colour_tangent(tangent, first, second, of_hidden, WIDTH, HIDDEN, PRECISION)
            at = derivatives + 24 * far + 6 * (1 + column) + axis
            tl.store(at, sigmoid * tangent, mask=there & (column < 3))


@triton.jit
def _distance(place, leave, radius, CONTRACTED: tl.constexpr):
    """Return the distance along a ray at a coordinate of ``RaySpacing``."""
    if CONTRACTED:
        beyond = tl.maximum(place - leave, 0.0)
        left = tl.maximum(1 - beyond / radius, 1.1920929e-07)
        return tl.minimum(place, leave) + beyond / left
    return place


@triton.jit
def _placed(distance, leave, radius, CONTRACTED: tl.constexpr):
    """Return the coordinate of ``RaySpacing`` at a distance along a ray, the inverse of ``_distance``."""
    if CONTRACTED:
        beyond = tl.maximum(distance - leave, 0.0)
        return tl.minimum(distance, leave) + beyond / (1 + beyond / radius)
    return distance


@triton.jit
def _slab(o, d, middle, half):
    """Return where a line enters and leaves the slab ``middle`` - ``half`` to ``middle`` + ``half`` of one axis."""
    tiny = 1.1754943508222875e-38
    slope = 1 / tl.where(tl.abs(d) < tiny, tiny, d)
    a, b = (middle - half - o) * slope, (middle + half - o) * slope
    return tl.minimum(a, b), tl.maximum(a, b)


@triton.jit
def _limits(rays, grid, ray, n, CONTRACTED: tl.constexpr):
    """Return a ray's origin, direction, limits in the coordinate of ``RaySpacing``, and where it leaves and enters the cube.

    ``rays`` are (8 n): origin, direction, near and far. ``grid`` has the cube's centre, half its side, the step, and the number of
    cells along a side.
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
    near, far = _placed(near, leave, half, CONTRACTED), _placed(far, leave, half, CONTRACTED)
    return ox, oy, oz, dx, dy, dz, near, far, leave, enter


@triton.jit
def _cell_at(x, y, z, grid, CONTRACTED: tl.constexpr):
    """Return the index of the cell that holds each point (world), or of the nearest one, and whether it is inside the grid."""
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
    rays, grid, offset, occupied, middles, counts, n,
    STEPS: tl.constexpr, MOST: tl.constexpr, CONTRACTED: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """Write the coordinates of the first ``MOST`` steps of each ray in occupied cells (r MOST), and how many there are.

    One program takes one ray. ``counts`` may exceed ``MOST``; the farther steps are then not stored.
    """
    ray = tl.program_id(0)
    ox, oy, oz, dx, dy, dz, near, far, leave, enter = _limits(rays, grid, ray, n, CONTRACTED)
    step = tl.load(grid + 4)
    first = tl.load(offset + ray)
    if not CONTRACTED:  # steps are counted from ``near``, and those before the grid are skipped
        first += tl.maximum(tl.floor((tl.minimum(tl.maximum(enter, 0.0), 1e9) - near) / step), 0.0)
    found = 0
    last = ((far - near) / step).to(tl.int32) + 1
    if not CONTRACTED:
        last = tl.minimum(last, STEPS)
    for chunk in range(0, last, CHUNK):
        place = near + (first + chunk + tl.arange(0, CHUNK)) * step
        distance = _distance(place, leave, tl.load(grid + 3), CONTRACTED)
        cell, inside = _cell_at(ox + distance * dx, oy + distance * dy, oz + distance * dz, grid, CONTRACTED)
        inside = inside & (place < far)
        matter = (tl.load(occupied + cell, mask=inside, other=0) != 0).to(tl.int32)
        at = found + tl.cumsum(matter, 0) - 1
        tl.store(middles + ray * MOST + at, place, mask=(matter != 0) & (at < MOST))
        found += tl.sum(matter, 0)
    tl.store(counts + ray, found)


@triton.jit
def _interval(middles, at, count, near, far, leave, grid, MOST: tl.constexpr, CONTRACTED: tl.constexpr):
    """Return the interval of one step around each of a ray's steps ``at`` (metres along the ray), clipped to the ray."""
    step, radius = tl.load(grid + 4), tl.load(grid + 3)
    there = (at >= 0) & (at < count)
    place = tl.load(middles + at, mask=there, other=0.0)
    start, end = tl.maximum(place - step / 2, near), tl.minimum(place + step / 2, far)
    if CONTRACTED:  # the remainder at the far end is short in the coordinate, but long in metres
        end = tl.where((at == count - 1) & (far - end < step), far, end)
    return _distance(start, leave, radius, CONTRACTED), _distance(end, leave, radius, CONTRACTED), there


@triton.jit
def _joined(middles, at, count, near, far, leave, grid, MOST: tl.constexpr, CONTRACTED: tl.constexpr):
    """Return the intervals without overlaps from rounding, see ``gathered``."""
    start, end, there = _interval(middles, at, count, near, far, leave, grid, MOST, CONTRACTED)
    following, _end, more = _interval(middles, at + 1, count, near, far, leave, grid, MOST, CONTRACTED)
    end = tl.where(more, tl.minimum(end, following), end)
    return start, tl.maximum(start, end), there


@triton.jit
def _absorbed(start, end, there, ox, oy, oz, dx, dy, dz, grid, density, thickest, CONTRACTED: tl.constexpr):
    """Return the optical thickness of intervals by the grid's densities, limited to ``thickest``."""
    middle = (start + end) / 2
    cell, _inside = _cell_at(ox + middle * dx, oy + middle * dy, oz + middle * dz, grid, CONTRACTED)
    thickness = tl.load(density + cell, mask=there, other=0.0) * (end - start)
    return tl.where(there, tl.minimum(thickness, thickest), 0.0)


@triton.jit
def _neighbour(values, by, J: tl.constexpr):
    """Return each value's neighbour, ``by`` places on; 0 where there is none."""
    here, other = tl.arange(0, J)[:, None], tl.arange(0, J)[None, :]
    return tl.sum(tl.where(other == here + by, values[None, :], 0.0), 1)


@triton.jit
def concentrate_kernel(
    rays, grid, middles, counts, density, shift, starts, ends, valid, n, thickest, tail,
    COUNT: tl.constexpr, EVEN: tl.constexpr, MOST: tl.constexpr, S: tl.constexpr, J: tl.constexpr, CONTRACTED: tl.constexpr,
):  # fmt: skip
    """Write ``COUNT`` intervals of each ray (r COUNT), concentrated where ``density`` has its weight, see ``Concentrated``.

    ``shift`` (r COUNT + 1) is added to the levels of the borders, by weight and then ``EVEN`` by length. One program takes one ray.
    """
    ray = tl.program_id(0).to(tl.int64)
    ox, oy, oz, dx, dy, dz, near, far, leave, _enter = _limits(rays, grid, ray, n, CONTRACTED)
    count = tl.minimum(tl.load(counts + ray), MOST)
    middles += ray * MOST
    j = tl.arange(0, J)
    stored = j < COUNT
    out = ray * COUNT + j
    if count <= COUNT:
        own_start, own_end, own = _joined(middles, j, count, near, far, leave, grid, MOST, CONTRACTED)
        last = _distance(far, leave, tl.load(grid + 3), CONTRACTED)
        tl.store(starts + out, tl.where(own, own_start, last), mask=stored)
        tl.store(ends + out, tl.where(own, own_end, last), mask=stored)
        tl.store(valid + out, own, mask=stored)
    else:
        i = tl.arange(0, S)
        start, end, there = _joined(middles, i, count, near, far, leave, grid, MOST, CONTRACTED)
        thickness = _absorbed(start, end, there, ox, oy, oz, dx, dy, dz, grid, density, thickest, CONTRACTED)
        a, b, there_a = _joined(middles, i - 1, count, near, far, leave, grid, MOST, CONTRACTED)
        before_own = _absorbed(a, b, there_a, ox, oy, oz, dx, dy, dz, grid, density, thickest, CONTRACTED)
        a, b, there_b = _joined(middles, i + 1, count, near, far, leave, grid, MOST, CONTRACTED)
        behind_own = _absorbed(a, b, there_b, ox, oy, oz, dx, dy, dz, grid, density, thickest, CONTRACTED)
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
        level = tl.where(j < by_weight, j / (by_weight - 1.0), (j - by_weight) / (EVEN - 1.0))
        level += tl.load(shift + ray * (COUNT + 1) + j, mask=j <= COUNT, other=0.0)
        dense = (tail + (1 - 2 * tail) * level)[None, :]
        below = share[:, None] <= dense
        x0 = tl.max(tl.where(below, share[:, None], 0.0), 0)
        y0 = tl.max(tl.where(below, laid[:, None], 0.0), 0)
        x1 = tl.min(tl.where(below, 1.0, share[:, None]), 0)
        y1 = tl.min(tl.where(below, total, laid[:, None]), 0)
        between = y0 + (tail + (1 - 2 * tail) * level - x0) * (y1 - y0) / tl.maximum(
            x1 - x0, 1.1754943508222875e-38
        )
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
        apart = (upper + _neighbour(lower, 1, J)) / 2
        lower = tl.where(j > 0, tl.maximum(lower, joint), lower)
        upper = tl.maximum(lower, tl.where(j < COUNT - 1, tl.minimum(upper, apart), upper))
        tl.store(starts + out, lower, mask=stored)
        tl.store(ends + out, upper, mask=stored)
        tl.store(valid + out, half > 0, mask=stored)
