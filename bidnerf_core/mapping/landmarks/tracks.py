"""Tracks: keypoints of several images that show the same scene point; from matching likely image pairs to fusing landmarks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.camera import poses_of_rows
from bidnerf_core.depth import UNKNOWN
from bidnerf_core.frames import SeenLandmarks
from bidnerf_core.geometry import SE3, mad_deviation
from bidnerf_core.mapping.geometry.triangulation import Sightings, sum_by, viewing_cones
from bidnerf_core.mapping.landmarks.descriptors import MANY, byte_of_zero, mutual_nearest
from bidnerf_core.mapping.landmarks.features import ImageKeypoints
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap, Tracks

EPIPOLAR_BAND = 2.0
"""Maximum distance (pixels) of a match from the epipolar line."""
LEAST_BASELINE = 1e-12
"""Distance (metres) between two cameras below which epipolar lines are undefined."""


CACHED = 2**18
"""Number of distances computed at a time, so that they stay in the processor's cache."""
ROWS = 192
"""Number of keypoints with successive epipolar lines that are compared at a time: their lines cover a tenth of a photo with 2,000
keypoints. With 64, fewer are compared, but the work for each block is most of the time, which is longer by two fifths."""
NEARBY = 128
"""Number of nearest cameras among which an image is matched. On a drawn building of 320 rooms of 20 photos, half of the pairs show the
same walls, as in a single room; among the nearest 500, or among all, fewer do."""


def likely_pairs(poses: Sequence[SE3], neighbours: int) -> Int[Tensor, "p 2"]:
    """Return pairs (i < j) of cameras with similar ``poses`` (T_world_camera), without duplicates.

    Of the cameras nearest to each, the dissimilarity is the distance between the centres relative to the mean over all such pairs, plus
    1 - cosine between the optical axes. Half of a camera's ``neighbours`` are those with the most similar poses. The other half are every
    third one of the cameras that follow in this order, because successive images of a video have too little baseline for triangulation.
    """
    others = min(len(poses) - 1, NEARBY)
    if others < 1:
        return torch.zeros((0, 2), dtype=torch.long)
    near = (neighbours + 1) // 2
    wanted = [*range(near), *(near + 2 + 3 * i for i in range(neighbours - near))]
    ranks = [rank for rank in wanted if rank < others] or list(range(others))
    centres = torch.stack([pose.translation.cpu().double() for pose in poses])
    axes = torch.stack([pose.rotation[:, 2].cpu().double() for pose in poses])
    away, number = map(torch.from_numpy, cKDTree(centres.numpy()).query(centres.numpy(), others + 1))
    # The camera itself is not always the first: several may be at one place.
    own = number == torch.arange(len(poses))[:, None]
    own[~own.any(1), -1] = True
    number, away = (each[~own].view(-1, others) for each in (number, away))
    unlike = away / max(float(away.mean()), 1e-12) + 1 - (axes[number] @ axes[..., None])[..., 0]
    chosen = number.gather(1, unlike.argsort(dim=1, stable=True)[:, ranks])
    ends = torch.arange(len(poses))[:, None].expand_as(chosen)
    return torch.stack([ends.minimum(chosen), ends.maximum(chosen)], dim=-1).view(-1, 2).unique(dim=0)


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Keypoint pairs of two images with similar descriptors, each near the other's epipolar line."""

    pairs: Int[Tensor, "p 2"]
    ambiguity: Float[Tensor, "p"]  # ratio of the best to the second-best descriptor distance


def epipolar_matches(a: ImageKeypoints, b: ImageKeypoints) -> PairMatches:
    """Return the pairs of keypoints of ``a`` and ``b`` that are mutual nearest neighbours near the epipolar lines.

    A match must also pass the ratio test among all keypoints of ``b``, because a keypoint that resembles many of them
    matches one near the line by chance.
    """
    n, m = len(a.keypoints), len(b.keypoints)
    if not n or not m:
        return PairMatches(torch.zeros((0, 2), dtype=torch.long), torch.zeros(0))
    x, y, lines = a.keypoints.descriptors.float(), b.keypoints.descriptors.float(), EpipolarLines.of(a, b)
    x_squares, y_squares = x.square().sum(-1, keepdim=True), y.square().sum(-1)
    pixels, reach = b.keypoints.pixels, (b.keypoints.sizes[:, None] / 2).clamp(min=4.0)

    def distances(rows: Tensor, columns: Tensor | slice) -> Float[Tensor, "r c"]:
        """Return the squared distances of keypoints of ``a`` to keypoints of ``b``."""
        return torch.addmm(y_squares[columns], x[rows], y[columns].T, alpha=-2).add_(x_squares[rows])

    def next_best(distance: Float[Tensor, "r c"], rows: Tensor, columns: Tensor | slice) -> Float[Tensor, "r"]:
        """Return the smallest distance of each keypoint to others than its partner and the partner's duplicates.

        Duplicates do not make a match ambiguous: SIFT returns one keypoint for each dominant orientation, and keypoints within the
        radius of a keypoint's neighbourhood also have similar descriptors.
        """
        exact = "donot_use_mm_for_euclid_dist"
        away = torch.cdist(pixels[partner[rows]], pixels[columns], compute_mode=exact)
        return distance.masked_fill_(away < reach[partner[rows]], torch.inf).amin(dim=1)

    best, partner = torch.full((n,), torch.inf), torch.zeros(n, dtype=torch.long)
    least, blocks = torch.full((m,), torch.inf), list[tuple[Tensor, Tensor, Tensor]]()
    for rows, columns in lines.blocks():
        distance = torch.where(lines.near(rows, columns), distances(rows, columns), torch.inf)
        best[rows], column = distance.min(1)
        partner[rows] = columns[column]
        least[columns] = least[columns].minimum(distance.amin(0))
        blocks.append((rows, columns, distance))
    mutual = (best == least[partner]) & best.isfinite()
    # Of keypoints with equal descriptors, the first one
    numbers = mutual.nonzero()[:, 0]
    first = torch.full((m,), n).scatter_reduce(0, partner[numbers], numbers, "amin")
    mutual[numbers] = first[partner[numbers]] == numbers
    for rows, columns, distance in blocks:
        own = mutual[rows]
        rows = rows[own]
        mutual[rows] = best[rows] < 0.85**2 * next_best(distance[own], rows, columns)
    numbers, every = mutual.nonzero()[:, 0], slice(None)
    others = [next_best(distances(rows, every), rows, every) for rows in numbers.split(max(1, CACHED // m))]
    nearest, second = best[numbers], torch.cat(others)
    good = nearest < 0.95**2 * second
    ambiguity = (nearest / second.clamp(min=1)).sqrt()
    return PairMatches(torch.stack([numbers, partner[numbers]], dim=-1)[good], ambiguity[good])


def matches_of_points(
    images: Sequence[ImageKeypoints], observed: Sequence[Int[Tensor, "k"]], positions: Float[Tensor, "p 3"]
) -> list[tuple[int, int, PairMatches]]:
    """Return matches between keypoints at the projections of the same known point, without ambiguity.

    ``observed`` holds the numbers of the points (metres, world) that each image shows. A keypoint belongs to a point if the
    keypoint and the point's projection are each other's nearest, and as close as a match must be to its epipolar line.
    """
    rows = list[Int[Tensor, "m 3"]]()  # point, image, keypoint
    for number, (image, points) in enumerate(zip(images, observed, strict=True)):
        if not (len(points) and len(image.keypoints)):
            continue
        local = image.T_ref_camera.inverse().apply(positions[points])
        pixels = image.intrinsics.project(local).nan_to_num(torch.inf)
        # Exact differences: products would round by about a pixel, and give NaN for points behind the camera.
        distance = torch.cdist(pixels.float(), image.keypoints.pixels, compute_mode="donot_use_mm_for_euclid_dist")
        shown, partner = mutual_nearest(distance.masked_fill(~(distance <= EPIPOLAR_BAND), torch.inf))
        rows.append(torch.stack([points[shown], torch.full_like(shown, number), partner], dim=-1))
    if not rows:
        return []
    seen = torch.cat(rows)
    seen = seen[seen[:, 0].argsort(stable=True)]  # images of a point in turn
    first, second = seen[:-1], seen[1:]
    same = first[:, 0] == second[:, 0]
    i, j, ends = first[same, 1], second[same, 1], torch.stack([first[same, 2], second[same, 2]], dim=-1)
    pairs, pair = (i * len(images) + j).unique(return_inverse=True)
    return [
        (
            int(code) // len(images),
            int(code) % len(images),
            PairMatches(ends[pair == n], torch.zeros(int((pair == n).sum()))),
        )
        for n, code in enumerate(pairs)
    ]


@dataclass(frozen=True, eq=False)
class EpipolarLines:
    """The epipolar half-lines, in an image, of the keypoints of another image.

    A half-line starts at the image of the ray's point at infinity. If the camera centres coincide, it reduces to that point.
    """

    start: Float[Tensor, "n 2"]
    across: Float[Tensor, "n 3"]  # distance from the line, of a homogeneous point of the image plane at distance 1
    along: Float[Tensor, "n 3"]  # distance from the start along the line
    least: Float[Tensor, "n 1"]  # of ``along``
    band: float
    seen: Float[Tensor, "3 m"]  # the keypoints of the image
    epipole: Float[Tensor, "3"]  # unit length, float64
    coincide: bool

    @staticmethod
    def of(a: ImageKeypoints, b: ImageKeypoints) -> EpipolarLines:
        """Return the half-lines of the keypoints of ``a`` in ``b``."""
        T_b_a = b.T_ref_camera.inverse() @ a.T_ref_camera
        rays, base = T_b_a.rotate(a.rays), T_b_a.translation
        front = rays[:, 2:].sign()
        start = rays[:, :2] / rays[:, 2:].abs().clamp(min=1e-9) * front
        step = (base[:2] - base[2] * start) * front  # direction in which the projection moves as the point comes nearer
        size = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
        forward = step / size.clamp(min=1e-300)
        sideways = torch.stack([-forward[:, 1], forward[:, 0]], dim=-1)
        seen = torch.cat([b.rays[:, :2], torch.ones_like(b.rays[:, :1])], dim=-1).float().mT
        band = EPIPOLAR_BAND / b.focal
        across, along = (
            torch.cat([axis, -(axis * start).sum(-1, keepdim=True)], dim=-1).float() for axis in (sideways, forward)
        )
        # If a ray points behind the other camera, its point at infinity has no projection, so the whole line is allowed.
        least = torch.where(front > 0, -band, -torch.inf).float()
        distance = torch.linalg.vector_norm(base)
        coincide = float(distance) < LEAST_BASELINE
        return EpipolarLines(start.float(), across, along, least, band, seen, base / distance, coincide)

    def near(self, rows: Int[Tensor, "r"], columns: Int[Tensor, "c"] | slice = slice(None)) -> Bool[Tensor, "r c"]:
        """Return whether the keypoints of the image with numbers ``columns`` lie near the half-lines with the numbers ``rows``."""
        seen = self.seen[:, columns]
        if self.coincide:
            return torch.cdist(self.start[rows], seen[:2].mT) <= self.band
        near = (self.across[rows] @ seen).abs_() <= self.band
        return near.logical_and_(self.along[rows] @ seen >= self.least[rows])

    def blocks(self) -> Iterator[tuple[Int[Tensor, "r"], Int[Tensor, "c"]]]:
        """Yield blocks of half-lines, and the keypoints that may lie near any of them, in ascending order; both as numbers.

        All lines pass through the epipole. Those that pass within the band of a keypoint have directions between the tangents from the
        epipole to a disc about the keypoint. Directions are angles in a basis of the lines' plane, so that the epipole may be at infinity.
        """
        lines, points = torch.arange(len(self.start)), torch.arange(self.seen.shape[1])
        if self.coincide:
            for rows in lines.split(max(1, CACHED // len(points))):
                yield rows, points
            return
        basis = torch.linalg.svd(self.epipole[None]).Vh[1:]  # of the lines through the epipole
        u, v = basis @ self.seen.double()
        gram = basis[:, :2] @ basis[:, :2].mT * (1.01 * self.band) ** 2
        # A line (cos, sin) meets the disc where (u cos + v sin)^2 <= (its length in the image times the radius)^2.
        mean = (u * u + v * v - gram.trace()) / 2
        towards = torch.atan2(u * v - gram[0, 1], (u * u - v * v - gram[0, 0] + gram[1, 1]) / 2)
        squared = u * u * gram[1, 1] + v * v * gram[0, 0] - 2 * u * v * gram[0, 1] - torch.det(gram)
        reach = torch.where(squared > 0, torch.atan2(squared.clamp(min=0).sqrt(), mean) / 2, torch.pi / 2)
        cosine, sine = basis @ self.across.double().mT
        angle, order = torch.atan2(sine, cosine).remainder(torch.pi).sort()
        for rows, angles in zip(order.split(ROWS), angle.split(ROWS), strict=True):
            middle, half = (angles[0] + angles[-1]) / 2, (angles[-1] - angles[0]) / 2
            # Differences of directions are between 0 and 90 degrees.
            away = ((towards / 2 - middle).remainder(torch.pi) - torch.pi / 2).abs()
            columns = points[away <= reach + half]
            if len(columns):
                yield rows, columns


def link_tracks(matches: Sequence[tuple[int, int, PairMatches]], sizes: Sequence[int]) -> Int[Tensor, "m"]:
    """Link pairwise matches into tracks and return the track label of each keypoint.

    ``matches`` holds, for each matched pair, the indices of its two images and the matches between their keypoints; ``sizes``
    holds the number of keypoints in each image. The m keypoints of all images are concatenated in image order. Labels are
    indices of keypoints, hence not consecutive; an unmatched keypoint is a track of its own.

    Matches are linked in order of increasing ambiguity. A match that would put two keypoints of the same image into one track
    is dropped, because a single wrong match would otherwise merge two correct tracks.
    """
    first = np.concatenate([[0], np.cumsum(sizes)])
    ends = np.concatenate([np.zeros((0, 2), np.int64)] + [m.pairs.numpy() + first[[i, j]] for i, j, m in matches])
    ambiguity = np.concatenate([np.zeros(0)] + [m.ambiguity.numpy() for _, _, m in matches])
    # Most keypoints have no match, so only those with one are considered.
    matched, ends = np.unique(ends, return_inverse=True)
    ends = ends.reshape(-1, 2)
    image = np.searchsorted(first, matched, side="right") - 1
    # Tuples take a quarter of the memory of sets, and lists of all matches at once would take most of it.
    parent, images = list(range(len(matched))), list[tuple[int, ...]](zip(image.tolist()))
    ends = ends[np.argsort(ambiguity, kind="stable")]
    for begin in range(0, len(ends), MANY):
        for a, b in ends[begin : begin + MANY].tolist():
            small, large = sorted((_root(parent, a), _root(parent, b)), key=lambda root: len(images[root]))
            if small != large and set(images[small]).isdisjoint(images[large]):
                parent[small] = large
                images[large], images[small] = images[large] + images[small], ()
    label = np.arange(first[-1])
    label[matched] = matched[[_root(parent, number) for number in range(len(matched))]]
    return torch.from_numpy(label)


def _root(parent: list[int], number: int) -> int:
    """Return the representative of a set (union-find with path halving, Tarjan and van Leeuwen 1984)."""
    while parent[number] != number:
        parent[number] = parent[parent[number]]
        number = parent[number]
    return number


@dataclass(frozen=True, eq=False)
class TrackedKeypoints:
    """Keypoints and the points that they observe. Keypoints are numbered consecutively over all images."""

    images: Sequence[ImageKeypoints]  # with poses T_world_camera
    point: Int[Tensor, "m"]
    number: Int[Tensor, "m"]  # of the keypoint, ascending

    def __getitem__(self, index: Tensor) -> TrackedKeypoints:
        return TrackedKeypoints(self.images, self.point[index], self.number[index])

    def compact(self) -> tuple[TrackedKeypoints, Int[Tensor, "n"]]:
        """Renumber the remaining points from 0, and also return their former numbers."""
        numbers, point = self.point.unique(return_inverse=True)
        return TrackedKeypoints(self.images, point, self.number), numbers

    @property
    def count(self) -> int:
        """The number of points."""
        return int(self.point.max()) + 1 if len(self.point) else 0

    @property
    def image(self) -> Int[Tensor, "m"]:
        last = torch.tensor([len(image.keypoints) for image in self.images]).cumsum(0)
        return torch.searchsorted(last, self.number, right=True)

    @property
    def motion(self) -> Float[Tensor, "v 6"]:
        """The motion of each image's camera from the first row to the last (metres, then radians)."""
        return torch.stack([p.motion for p in self.images])

    @cached_property
    def sightings(self) -> Sightings:
        """The keypoints as observations by cameras at the poses at which their rows were exposed."""
        image, motion = self.image, self.motion
        times = torch.cat([p.exposure_times for p in self.images])[self.number]
        T = SE3.stack([p.T_ref_camera for p in self.images])[image]
        if bool(motion.any()):
            T = T @ poses_of_rows(times, motion[image])
        focal = torch.tensor([p.focal for p in self.images], dtype=torch.float64)
        rays = torch.cat([p.rays for p in self.images])[self.number]
        return Sightings(self.point, image, T.rotation.mT, T.translation, rays[:, :2], focal[image], times)

    def by_image(self, part: Callable[[ImageKeypoints], Tensor]) -> Iterator[Tensor]:
        """Yield a part of the keypoints of each image, such as their descriptors, which take much memory together."""
        first = torch.tensor([0, *(len(image.keypoints) for image in self.images)]).cumsum(0)
        bounds = torch.searchsorted(self.number, first).tolist()
        for image, start, (begin, end) in zip(self.images, first.tolist(), pairwise(bounds), strict=False):
            yield part(image)[self.number[begin:end] - start]

    @property
    def pixels(self) -> Float[Tensor, "m 2"]:
        """Where the keypoints were detected in their images."""
        return torch.cat([*self.by_image(lambda image: image.keypoints.pixels)])

    @property
    def depth(self) -> Float[Tensor, "m"]:
        """The depth measured at each keypoint, metres; 0 where none was measured."""
        return torch.cat([*self.by_image(lambda image: image.depth)])


def fuse_landmarks(
    observations: TrackedKeypoints,
    positions: Float[Tensor, "n 3"],
    covariance: Float[Tensor, "n 3 3"],
    noise: float,
) -> LandmarkMap:
    """Return landmarks at ``positions`` (metres, world) with ``covariance`` (square metres); each needs at least one observation.

    ``noise`` is the noise of a keypoint (pixels). The images' poses are taken as exact: ``pose_covariance`` is 0.
    """
    count, sightings = len(positions), observations.sightings
    away = sightings.centre - positions[sightings.point]
    towards = away / torch.linalg.vector_norm(away, dim=-1, keepdim=True).clamp(min=1e-300)
    directions, cones = viewing_cones(towards, sightings.point, count)
    views = torch.bincount(sightings.point, minlength=count)
    sizes = torch.cat([*observations.by_image(lambda image: image.keypoints.sizes)])
    descriptors = partial(observations.by_image, lambda image: image.keypoints.descriptors)
    along = (directions[:, None] @ covariance @ directions[..., None])[:, 0, 0]
    across = (covariance.diagonal(dim1=-2, dim2=-1).sum(-1) - along) / 2  # the variances of both axes averaged
    metres = sizes * sightings.in_camera(positions)[:, 2].clamp(min=0) / sightings.focal
    return LandmarkMap(
        positions.float(),
        torch.stack([across, along], dim=-1).clamp(min=0).sqrt().float(),
        _mean_descriptors(descriptors, sightings.point, count),
        directions.float(),
        cones.float(),
        (sum_by(metres, sightings.point, count) / views.clamp(min=1)).float(),
        views.int(),
        noise,
        torch.zeros((6, 6), dtype=torch.float64),
        tracks=Tracks(sightings.point.int(), sightings.view.int(), observations.pixels.float()),
    )


def landmarks_by_image(
    observations: TrackedKeypoints, positions: Float[Tensor, "n 3"], covariance: Float[Tensor, "n 3 3"]
) -> list[SeenLandmarks]:
    """Return the landmarks, at ``positions`` (metres, world), seen in each image, with the standard deviation of their distance."""
    sightings, image = observations.sightings, observations.image
    away = positions[sightings.point] - sightings.centre
    distance = torch.linalg.vector_norm(away, dim=-1)
    ray = away / distance[:, None].clamp(min=1e-300)
    variance = (ray[:, None] @ covariance[sightings.point] @ ray[..., None])[:, 0, 0]
    parts = observations.pixels.float(), distance.float(), variance.clamp(min=0).sqrt().float()
    return [SeenLandmarks(*(part[image == i] for part in parts)) for i in range(len(observations.images))]


def _mean_descriptors(
    parts: Callable[[], Iterator[UInt8[Tensor, "k d"]]], point: Int[Tensor, "m"], count: int
) -> UInt8[Tensor, "n d"]:
    """Return the mean descriptor of each point, rescaled to the mean norm, since a shorter descriptor is closer to all others.

    ``parts`` returns the descriptors of the observations image by image, since all together take much memory.
    """
    zero, channels, first = byte_of_zero(parts()), next(parts()).shape[1], 0
    total, lengths = torch.zeros((count, channels)), torch.zeros((count, 1))
    for descriptors in parts():
        values = descriptors.float().sub_(zero)
        of_points = point[first : first + len(values)]
        total.index_add_(0, of_points, values)
        lengths.index_add_(0, of_points, torch.linalg.vector_norm(values, dim=-1, keepdim=True))
        first += len(values)
    number = torch.bincount(point, minlength=count).clamp(min=1)[:, None]
    total /= number  # the mean; in place, as it takes much memory
    norm = torch.linalg.vector_norm(total, dim=-1, keepdim=True).clamp(min=1e-9)
    total *= lengths / number
    total /= norm
    return total.add_(zero).round_().clamp_(0, 255).to(torch.uint8)


ENOUGH_DEPTHS = 30
"""Minimum number of triangulated observations with depth from which the depth noise is estimated."""


def keypoint_depth_noise(observations: TrackedKeypoints, points: Float[Tensor, "n 3"]) -> float:
    """Return a robust relative standard deviation of measured depth, by comparison with triangulated points.

    With too few points, the result is that of an unknown sensor.
    """
    depth = observations.depth
    known = depth > 0
    if int(known.sum()) < ENOUGH_DEPTHS:
        return UNKNOWN.noise.linear
    return max(1e-4, mad_deviation(depth[known] / observations.sightings.in_camera(points)[known, 2] - 1))


def depth_ratio(observations: TrackedKeypoints, points: Float[Tensor, "n 3"]) -> float | None:
    """Return the median ratio of measured to triangulated depth over the keypoints that have both; None if there are too few."""
    z, depth = observations.sightings.in_camera(points)[:, 2], observations.depth
    known = (depth > 0) & (z > 0)
    return float((depth[known] / z[known]).median()) if int(known.sum()) >= ENOUGH_DEPTHS else None


def back_project(
    observations: TrackedKeypoints, relative: float, pixel_noise: float
) -> tuple[TrackedKeypoints, Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Back-project keypoints; return the inliers, the weighted mean point of each track (metres, world), and its covariance.

    ``relative`` is the relative noise of the depth, and ``pixel_noise`` the noise of the keypoints (pixels). Tracks without a
    majority of inliers are dropped.
    """
    observations, _ = observations[observations.depth > 0].compact()
    sightings, depth = observations.sightings, observations.depth
    ray = torch.cat([sightings.image, torch.ones_like(sightings.image[:, :1])], dim=-1) * depth[:, None]
    world = (sightings.rotation.mT @ ray[..., None])[..., 0] + sightings.centre
    # The noise of depth is along the ray, and that of the keypoint across it.
    d = sightings.directions()
    along = d[:, :, None] * d[:, None]
    sideways = (pixel_noise * depth / sightings.focal) ** -2
    information = (torch.eye(3, dtype=d.dtype) - along) * sideways[:, None, None]
    information = along * ((relative * depth) ** -2)[:, None, None] + information
    mean, _ = _weighted_mean(world, information, observations.point)
    difference = (world - mean[observations.point])[..., None]
    agree = (difference.mT @ information @ difference)[:, 0, 0] <= 3**2  # three standard deviations
    tracks = torch.bincount(observations.point)
    majority = 2 * torch.bincount(observations.point[agree], minlength=len(tracks)) > tracks
    inliers = agree & majority[observations.point]
    observations, _ = observations[inliers].compact()
    return observations, *_weighted_mean(world[inliers], information[inliers], observations.point)


def _weighted_mean(
    values: Float[Tensor, "m 3"], information: Float[Tensor, "m 3 3"], point: Int[Tensor, "m"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return the weighted mean of each point's values, and the covariance of that mean."""
    count = int(point.max()) + 1 if len(point) else 0
    total = sum_by(information, point, count)
    weighted = sum_by((information @ values[..., None])[..., 0], point, count)
    covariance = torch.linalg.inv(total)
    return (covariance @ weighted[..., None])[..., 0], covariance
