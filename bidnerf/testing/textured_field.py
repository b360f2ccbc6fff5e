"""A textured, hilly ground in closed form, whose images have keypoints: as a field, as views and as a complete map."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf.scenes import MovedField, orbit
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import FieldValues, RadianceField, RaySampler, SceneBounds, Stratified, render_image
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import BakeConfig, LandmarkMap, SurfaceMap, bake, build_landmarks

BOUNDS = SceneBounds((-1.2, -1.2, -0.3), (1.2, 1.2, 0.3), 0.1, 6.0)
GROUND_CAMERA = Intrinsics(130.0, 130.0, 64.0, 48.0, 128, 96)
POSES = orbit(1.7, 3, elevation=(50.0, 70.0), seed=5)
"""Poses (T_world_camera) that no training image has."""


@dataclass(init=False, eq=False)  # a dataclass, so that ``moved`` finds its tensors
class TexturedGround:
    """A ground of height ``h(x, y)`` whose colours are sums of random waves; infinitely differentiable."""

    sampler: RaySampler
    waves: Float[Tensor, "2 w"]  # radians per metre
    phases: Float[Tensor, "w"]
    weights: Float[Tensor, "w 3"]

    def __init__(self, seed: int = 0) -> None:
        self.sampler = Stratified(64)
        generator = torch.Generator().manual_seed(seed)
        self.waves = 18 * torch.randn((2, 24), generator=generator)
        self.phases = 6.3 * torch.rand(24, generator=generator)
        self.weights = 0.3 * torch.randn((24, 3), generator=generator)

    def height(self, positions: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p"]:
        """Return the height (metres) of the ground above or below positions."""
        return 0.12 * (3 * positions[..., 0]).sin() * (2.5 * positions[..., 1] + 1).sin()

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        # The density, per metre, rises over about a centimetre.
        density = 120 * torch.sigmoid((self.height(positions) - positions[..., 2]) / 0.01)
        signal = (positions[..., :2] @ self.waves.to(positions) + self.phases.to(positions)).sin()
        return FieldValues(density, torch.sigmoid(2 * signal @ self.weights.to(positions)))


@dataclass(frozen=True, eq=False)
class MapWithLandmarks:
    """A map in memory, made from a field and, where given, baked landmarks and a baked surface."""

    field: RadianceField
    bounds: SceneBounds
    landmarks: LandmarkMap | None
    surface: SurfaceMap | None = None
    colour_noise: float | None = 0.0
    has_distances: bool = True


@functools.cache
def ground(seed: int = 0) -> TexturedGround:
    return TexturedGround(seed)


def textured_view(T: SE3, name: str = "", seed: int = 0, camera: Intrinsics = GROUND_CAMERA) -> View:
    """Return an image of the ground, with its depth."""
    image = render_image(ground(seed), camera, T, BOUNDS, chunk=512)  # whose waves stay in the cache
    return View(Frame(name, image.rgb, camera, torch.where(image.opacity > 0.95, image.depth, 0)), T)


def photograph(T: SE3, camera: Intrinsics) -> Float[Tensor, "h w 3"]:
    """Return the colours of the ground from a camera above it, by the intersections of its rays; fast, and without depth."""
    directions = T.rotate(camera.unproject(camera.pixel_centres(torch.float64)))
    positions = T.translation.expand_as(directions)
    for _ in range(10):  # a fixed point: the rays are steeper than the ground
        ahead = (ground().height(positions) - T.translation[2]) / directions[..., 2]
        positions = T.translation + ahead[..., None] * directions
    return ground().query(positions, directions).rgb.float()


@functools.cache
def training_views(count: int = 10) -> tuple[View, ...]:
    return tuple(
        textured_view(T, f"{number:04d}") for number, T in enumerate(orbit(1.8, count, elevation=(45.0, 75.0), seed=0))
    )


@functools.cache
def unseen() -> View:
    """Return an image of the ground that was not used to build the landmarks."""
    return textured_view(POSES[1], "unseen")


@functools.cache
def textured_map(surface: bool = False) -> MapWithLandmarks:
    if surface:
        return replace(textured_map(), surface=bake(ground(), BOUNDS, [], training_views(), BakeConfig(cells=200_000)))
    # As a trial of a map on its own images finds them; those of a map without a trial are far more cautious.
    scatter = torch.full((4,), 0.004, dtype=torch.float64)
    landmarks = replace(build_landmarks(training_views()), correlation=3.0, calibration_scatter=scatter)
    return MapWithLandmarks(ground(), BOUNDS, landmarks)


T_MOVED_WORLD = SE3(
    torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64),
    torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64),
)
"""Pose of the ground's world in another world, turned by 90 degrees about z, so that the box stays axis-aligned."""


@functools.cache
def moved_map() -> MapWithLandmarks:
    """Return the map of the same ground in a world moved by ``T_MOVED_WORLD``, rebuilt from the same images."""
    moved = MovedField(ground(), T_MOVED_WORLD)
    corners = T_MOVED_WORLD.apply(torch.tensor([BOUNDS.lower, BOUNDS.upper], dtype=torch.float64))
    lower, upper = (tuple(side.tolist()) for side in (corners.amin(0), corners.amax(0)))
    bounds = replace(BOUNDS, lower=lower, upper=upper)
    views = [replace(v, T_ref_camera=(T_MOVED_WORLD @ v.T_ref_camera).normalized()) for v in training_views()]
    surface = bake(moved, bounds, [], views, BakeConfig(cells=200_000))
    return MapWithLandmarks(moved, bounds, build_landmarks(views), surface)
