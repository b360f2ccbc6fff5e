"""Triton kernels for a GPU: the encoding with its derivatives, and the whole field with its derivatives.

On a GPU, the pure-torch path needs hundreds of launches, each of which takes longer to start than to compute. Each kernel here
replaces dozens of torch operations by one launch. The torch path is the reference against which the kernels are tested (on a
CPU, by Triton's interpreter). Triton comes with torch's CUDA build. A tile is (points, columns), where a column is a feature of a level.
"""

from __future__ import annotations

import triton
import triton.language as tl

# mypy: ignore-errors


@triton.jit
def _cells(x, y, z, resolution, entries, hashed, stride_y, stride_z):
    """Return the index terms of the cell's lower corner, and the position in the cell as a fraction, along each axis."""
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
def _encode(
    x, y, z, inside, table, resolution, entries, hashed, stride_y, stride_z, F: tl.constexpr, SMOOTH: tl.constexpr
):
    """Return the features at positions (points, 1) in the unit cube, and their derivatives by x, y and z, with eight reads per column."""
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
    c011 = tl.load(table + F * _index(tx, ty + stride_y, tz + stride_z, entries, hashed), mask=inside, other=0.0)
    c111 = tl.load(table + F * _index(tx + 1, ty + stride_y, tz + stride_z, entries, hashed), mask=inside, other=0.0)
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
    points,
    values,
    slopes,
    meta,
    tables,
    offsets,
    n,
    width,
    LEVELS: tl.constexpr,
    F: tl.constexpr,
    C: tl.constexpr,
    SMOOTH: tl.constexpr,
    SLOPES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Encode points (3 n): values (n width) and, with ``SLOPES``, derivatives (3 n width)."""
    row = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK))[:, None]
    there = row < n
    x = tl.load(points + row, mask=there, other=0.0)
    y = tl.load(points + n + row, mask=there, other=0.0)
    z = tl.load(points + 2 * n + row, mask=there, other=0.0)
    table, resolution, entries, hashed, stride_y, stride_z, used = _columns(meta, tables, offsets, LEVELS, F, C)
    value, by_x, by_y, by_z = _encode(
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
    points,
    gradient,
    meta,
    tables,
    offsets,
    n,
    width,
    LEVELS: tl.constexpr,
    F: tl.constexpr,
    C: tl.constexpr,
    SMOOTH: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Add the gradient (n width) of the encoding to the tables' gradients: the transpose of ``encode_kernel``."""
    row = (tl.program_id(0) * BLOCK + tl.arange(0, BLOCK))[:, None]
    there = row < n
    x = tl.load(points + row, mask=there, other=0.0)
    y = tl.load(points + n + row, mask=there, other=0.0)
    z = tl.load(points + 2 * n + row, mask=there, other=0.0)
    table, resolution, entries, hashed, stride_y, stride_z, used = _columns(meta, tables, offsets, LEVELS, F, C)
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
    basis = tl.where(column == 0, 0.28209479177387814, 0.0)
    basis = tl.where(column == 1, 0.4886025119029199 * y, basis)
    basis = tl.where(column == 2, 0.4886025119029199 * z, basis)
    basis = tl.where(column == 3, 0.4886025119029199 * x, basis)
    basis = tl.where(column == 4, 1.0925484305920792 * x * y, basis)
    basis = tl.where(column == 5, 1.0925484305920792 * y * z, basis)
    basis = tl.where(column == 6, 0.31539156525252005 * (3 * z * z - 1), basis)
    basis = tl.where(column == 7, 1.0925484305920792 * x * z, basis)
    return tl.where(column == 8, 0.5462742152960396 * (x * x - y * y), basis)


@triton.jit
def _harmonics_along(x, y, z, column, AXIS: tl.constexpr):
    """Return the derivatives of ``_harmonics`` by x (``AXIS`` 0), y or z."""
    a, b, c, d = 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
    if AXIS == 0:
        slope = tl.where(column == 3, a, 0.0)
        slope = tl.where(column == 4, b * y, slope)
        slope = tl.where(column == 7, b * z, slope)
        return tl.where(column == 8, 2 * d * x, slope)
    if AXIS == 1:
        slope = tl.where(column == 1, a, 0.0)
        slope = tl.where(column == 4, b * x, slope)
        slope = tl.where(column == 5, b * z, slope)
        return tl.where(column == 8, -2 * d * y, slope)
    slope = tl.where(column == 2, a, 0.0)
    slope = tl.where(column == 5, b * y, slope)
    slope = tl.where(column == 6, 6 * c * z, slope)
    return tl.where(column == 7, b * x, slope)


@triton.jit
def _tile(start, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    return tl.load(start + tl.arange(0, ROWS)[:, None] * COLUMNS + tl.arange(0, COLUMNS)[None, :])


@triton.jit
def _colour_layers(start, WIDTH: tl.constexpr, FEATURES: tl.constexpr, HIDDEN: tl.constexpr):
    """Return the offsets of the colour network's weights: those for the features, the harmonics, the hidden layers and the output."""
    of_harmonics = start + FEATURES * WIDTH
    of_hidden = of_harmonics + 16 * WIDTH
    return start, of_harmonics, of_hidden, of_hidden + HIDDEN * WIDTH * WIDTH


@triton.jit
def _colour_tangent(
    tangent, first, second, weights, WIDTH: tl.constexpr, HIDDEN: tl.constexpr, PRECISION: tl.constexpr
):
    """Propagate the tangent (points, WIDTH) of the first hidden layer's inputs forward to the logits."""
    tangent = tl.where(first, tangent, 0.0)
    if HIDDEN:
        tangent = tl.dot(tangent, _tile(weights, WIDTH, WIDTH), input_precision=PRECISION)
        tangent = tl.where(second, tangent, 0.0)
    return tl.dot(tangent, _tile(weights + HIDDEN * WIDTH * WIDTH, WIDTH, 16), input_precision=PRECISION)


@triton.jit
def field_kernel(
    positions,
    directions,
    values,
    derivatives,
    index,
    count,
    meta,
    tables,
    offsets,
    weights,
    biases,
    box,
    n,
    LEVELS: tl.constexpr,
    F: tl.constexpr,
    C: tl.constexpr,
    WIDTH: tl.constexpr,
    FEATURES: tl.constexpr,
    HIDDEN: tl.constexpr,
    SMOOTH: tl.constexpr,
    CONTRACTED: tl.constexpr,
    LIMIT: tl.constexpr,
    DERIVATIVES: tl.constexpr,
    SOME: tl.constexpr,
    BLOCK: tl.constexpr,
    PRECISION: tl.constexpr,
):
    """Compute density and colour (n 4) at points (n 3, world) along directions (n 3) and, with ``DERIVATIVES``, (n 4 6).

    Derivatives by position (three) and by direction (three) are propagated forward with the values. ``box`` holds the scene's
    centre, the factor to the cube [-1, 1] and the factor of the density. Layers are padded with zeros to ``WIDTH`` units and
    ``FEATURES`` features, the first of which is the log density; ``weights`` holds the layers one after the other, each (inputs,
    outputs). With ``SOME``, only the points whose numbers are the first ``count`` entries of ``index`` are computed.
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
    table, resolution, entries, hashed, stride_y, stride_z, used = _columns(meta, tables, offsets, LEVELS, F, C)
    x = tl.minimum(tl.maximum(ux, 0.0), 1.0)
    y = tl.minimum(tl.maximum(uy, 0.0), 1.0)
    z = tl.minimum(tl.maximum(uz, 0.0), 1.0)
    encoded, by_x, by_y, by_z = _encode(
        x, y, z, there & used, table, resolution, entries, hashed, stride_y, stride_z, F, SMOOTH
    )
    column = tl.arange(0, 16)[None, :]
    dx = tl.load(directions + 3 * far, mask=there, other=0.0)
    dy = tl.load(directions + 3 * far + 1, mask=there, other=0.0)
    dz = tl.load(directions + 3 * far + 2, mask=there, other=0.0)

    into, out_of = weights, weights + C * WIDTH
    of_features, of_harmonics, of_hidden, of_logits = _colour_layers(out_of + WIDTH * FEATURES, WIDTH, FEATURES, HIDDEN)
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
                    by_axis = by_axis * shrink + along * tl.where(largest, turn * tl.where(mine > 0, 1.0, -1.0), 0.0)
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
