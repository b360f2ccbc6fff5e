"""Fields by cell: one field whose cells are fields of another backend, trained one after another or side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import bidnerf as bn
import tiny
from bidnerf.scenes import GaussianBlobs
from bidnerf.testing import SCENE_BOUNDS, BackendContract, Recorder, awkward_rays, rgbd_views
from bidnerf_cells import CellsConfig, CellsField, backend
from bidnerf_cells.field import CellGrid
from bidnerf_cells.photos import of_mean_exposure, surface_depth, view_of_cell
from bidnerf_core.errors import InputError
from bidnerf_core.fields import FieldValues, SceneBounds, Stratified, render
from bidnerf_core.frames import Frame, SeenLandmarks, View
from bidnerf_core.geometry import SE3
from bidnerf_core.registry import registered
from bidnerf_core.training import ColourTransforms, TrainingStopped
from simulated_device import StaysOnDevice

INNER = (
    "levels=3",
    "log2_table_size=9",
    "base_resolution=4",
    "finest_resolution=16",
    "width=16",
    "geometry_features=3",
    "grid_resolution=16",
    "coarse_levels=1",
    "samples_per_step=1024",
    "rays_at_most=256",
    "prune_from=4",
    "prune_every=4",
    "learning_rate=0.1",
)
BOX = SceneBounds((-2.0, 1.0, 0.0), (4.0, 3.0, 2.0), 0.1, 20.0, (0.2, 0.4, 0.6))


@pytest.mark.slow
class TestCells(StaysOnDevice, BackendContract):
    backend = backend
    config = CellsConfig(inner_settings=(*INNER, "depth_weight=0.01"), steps=480, overview_share=0.2)


# A backend whose fields are in closed form, and do not learn.


@dataclass(frozen=True)
class BlobsConfig:
    steps: int = 1
    offset: bool = False  # whether each field differs from the others


class BlobsField(nn.Module):
    """Coloured clouds in the unit cube, brighter and thicker the farther the field's box is along x if it has an ``offset``."""

    def __init__(self, config: BlobsConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.clouds, self.sampler = GaussianBlobs.random(), Stratified(200)
        self.factor = 1 + (bounds.centre[0] + 2) / 10 if config.offset else 1.0
        self.steps = nn.Parameter(torch.zeros(()))

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        values = self.clouds.query(positions, directions)
        return FieldValues(self.factor * values.density, values.rgb / self.factor)


class BlobsBackend:
    summary, config_type, build = "clouds in closed form", BlobsConfig, staticmethod(BlobsField)

    def train(self, field: BlobsField, views: Sequence[View], config: BlobsConfig, report: Any) -> None:
        field.steps.data += config.steps


@pytest.fixture
def blobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registered, ("backends", "blobs"), BlobsBackend())


def trained(bounds: SceneBounds = SCENE_BOUNDS, **settings: Any) -> CellsField:
    """A field of cells, all of which count as trained."""
    field = backend.build(CellsConfig(**settings), bounds)
    field.trained.fill_(True)
    return field.requires_grad_(False)


# The grid of cells.


@pytest.mark.parametrize(("cells", "counts"), [(1, (1, 1, 1)), (2, (2, 1, 1)), (3, (3, 1, 1)), (6, (6, 2, 2))])
def test_cells_are_about_as_long_as_wide(cells: int, counts: tuple[int, int, int]) -> None:
    grid = CellGrid.of(CellsConfig(cells=cells), BOX)
    assert grid.counts == counts
    assert len(backend.build(CellsConfig(cells=cells, inner_settings=INNER), BOX).cells) == torch.tensor(counts).prod()


def test_shares_add_up_to_one_and_the_nearest_cell_has_what_is_outside() -> None:
    grid = CellGrid(BOX, (3, 1, 2), 0.25)
    points = torch.tensor(BOX.lower) - 3 + torch.rand(5_000, 3, generator=torch.Generator().manual_seed(0)) * 12
    shares = grid.weights(points.double())
    assert shares.shape == (5_000, 6)
    assert shares.min() >= 0
    torch.testing.assert_close(shares.sum(-1), torch.ones(5_000).double())
    for number in range(6):  # beyond the zones in which two are blended, each has its own box for itself
        lower, upper = (torch.tensor(corner) for corner in grid.box(number, -0.125, endless=True))
        inside = ((points > lower) & (points < upper)).all(-1)
        assert inside.any()
        assert (shares[inside, number] == 1).all()
        outer_lower, outer_upper = (torch.tensor(corner) for corner in grid.box(number, 0.125, endless=True))
        beyond = ((points < outer_lower) | (points > outer_upper)).any(-1)
        assert (shares[beyond, number] == 0).all()


def test_the_box_of_a_cell_includes_where_it_is_blended() -> None:
    grid = CellGrid(BOX, (3, 1, 2), 0.5)
    middle = grid.bounds_of(2)  # x second of three, z lower of two
    assert (middle.lower, middle.upper) == ((-0.5, 1.0, 0.0), (2.5, 3.0, 1.25))
    assert (middle.background, middle.near) == (BOX.background, BOX.near)


# The field.


@pytest.mark.usefixtures("blobs")
def test_cells_that_hold_the_same_are_that_field() -> None:
    field, one = trained(inner="blobs", cells=3), BlobsField(BlobsConfig(), SCENE_BOUNDS)
    positions, directions = torch.rand(2, 500, 3, generator=torch.Generator().manual_seed(0)).double() * 2 - 1
    found, expected = field.query(positions, directions), one.query(positions, directions)
    torch.testing.assert_close(found.density, expected.density)
    torch.testing.assert_close(found.rgb, expected.rgb)
    rays = awkward_rays()["rays from outside"]
    torch.testing.assert_close(render(field, rays).rgb, render(one, rays).rgb, atol=2e-3, rtol=0)


@pytest.mark.usefixtures("blobs")
def test_derivatives_go_on_across_borders() -> None:
    """The derivative by position is that of finite differences along a line across two borders, also where blending begins."""
    field = trained(inner="blobs", inner_settings=("offset=true",), cells=3, overlap=0.5)
    along = torch.linspace(-1, 1, 1201, dtype=torch.float64)
    points = torch.stack([along, torch.full_like(along, 0.11), torch.full_like(along, -0.17)], -1).requires_grad_()
    directions = torch.tensor([0.0, 0.0, 1.0]).double().expand_as(points)
    values = field.query(points, directions)
    for channel in (values.density, *values.rgb.unbind(-1)):
        (slope,) = torch.autograd.grad(channel.sum(), points, retain_graph=True)
        step = float(along[1] - along[0])
        numeric = (channel[2:] - channel[:-2]).detach() / (2 * step)
        assert (numeric - slope[1:-1, 0]).abs().max() < 2e-3 * numeric.abs().max()
        assert slope[:, 0].diff().abs().max() < 0.05 * slope.abs().max()  # no jumps


@pytest.mark.usefixtures("blobs")
def test_samples_cover_each_ray_once_in_the_order_of_cells() -> None:
    field = trained(inner="blobs", cells=4)
    for rays in awkward_rays().values():
        samples = field.sampler(rays)
        lengths = torch.where(samples.valid, samples.ends - samples.starts, 0).sum(-1)
        torch.testing.assert_close(lengths, (rays.far - rays.near).clamp(min=0), atol=1e-4, rtol=1e-4)


@pytest.mark.usefixtures("blobs")
def test_cells_that_are_not_trained_show_the_overview() -> None:
    field = trained(inner="blobs", inner_settings=("offset=true",), cells=2)
    points, directions = torch.tensor([[-0.9, 0.1, 0.1], [0.9, 0.1, 0.1]]), torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    both, overview = field.query(points, directions), field.overview.query(points, directions)
    field.trained[:4] = False  # those of the lower half along x
    found = field.query(points, directions)
    assert not torch.allclose(both.density[0], overview.density[0])
    torch.testing.assert_close(found.density, torch.stack([overview.density[0], both.density[1]]))
    torch.testing.assert_close(found.rgb, torch.stack([overview.rgb[0], both.rgb[1]]))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (("width",), "'width', expected NAME=VALUE"),
        (("steps=3",), "`steps` on its own"),
        (("wdith=3",), "has no setting 'wdith'"),
        (("width=wide",), "width"),
    ],
)
def test_settings_that_the_cells_do_not_have_are_refused(settings: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        CellsConfig(inner_settings=settings)


# What photos show of a cell.


def photo(depth: float, **changes: Any) -> View:
    """A photo along x from the left end of the box at a wall, of which the right half is as near again."""
    z = torch.full((6, 8), depth)
    z[:, 4:] *= 2
    frame = Frame("a", torch.full((6, 8, 3), 0.5), tiny.CAMERA.resized(8, 6), depth=z, **changes)
    axes = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).double()
    return View(frame, SE3(axes, torch.tensor([-1.9, 2.0, 1.0]).double()))


def test_a_cell_sees_its_surfaces_and_through_it_and_nothing_behind_other_surfaces() -> None:
    """The left half of the wall lies in the first of three cells along x, and its right half in the second."""
    grid = CellGrid(BOX, (3, 1, 1), 0.1)
    pixels = torch.tensor([[1.0, 1.0], [6.0, 1.0]])
    view = replace(photo(1.5), landmarks=SeenLandmarks(pixels, torch.tensor([1.5, 3.0]), torch.ones(2)))
    first, second, third = (view_of_cell(view, view.frame.depth, grid, number) for number in range(3))  # type: ignore[arg-type]
    inside, shown = torch.tensor([1.0, 0.0]).repeat_interleave(4).expand(6, 8), first.frame  # type: ignore[union-attr]
    assert shown.hidden is None
    assert torch.equal(shown.alpha, inside)  # type: ignore[arg-type]
    assert torch.equal(shown.depth, 1.5 * inside)  # type: ignore[arg-type]
    torch.testing.assert_close(shown.rgb[0, 7], torch.tensor(BOX.background), atol=2e-3, rtol=0)
    assert first.landmarks.distance.tolist() == [1.5]  # type: ignore[union-attr]
    shown = second.frame  # type: ignore[union-attr]
    assert torch.equal(shown.hidden, inside == 1)  # type: ignore[arg-type]
    assert torch.equal(shown.depth, 3.0 * (1 - inside))  # type: ignore[arg-type]
    assert second.landmarks.distance.tolist() == [3.0]  # type: ignore[union-attr]
    assert third is None


def test_in_open_space_a_cell_shows_what_is_behind_it() -> None:
    grid = CellGrid(replace(BOX, contracted=True), (3, 1, 1), 0.1)
    view = photo(1.5)
    first: Any = view_of_cell(view, view.frame.depth, grid, 0)  # type: ignore[arg-type]
    assert first.frame.alpha is None
    assert first.frame.hidden is None
    assert torch.equal(first.frame.depth, view.frame.depth)  # type: ignore[arg-type]


@pytest.mark.usefixtures("blobs")
def test_where_nothing_was_measured_the_overview_shows_the_surface() -> None:
    field, view = trained(inner="blobs"), rgbd_views()[0]
    depth = view.frame.depth.clone()  # type: ignore[union-attr]
    depth[:12] = 0
    some = surface_depth(replace(view, frame=view.frame.replace(depth=depth)), field)
    none = surface_depth(replace(view, frame=view.frame.replace(depth=None)), field)
    assert torch.equal(some[12:][depth[12:] > 0], depth[12:][depth[12:] > 0])
    assert torch.equal(some[:12], none[:12])
    assert 0.1 < (none > 0).float().mean() < 0.9
    assert (none[view.frame.alpha == 0] == 0).all()


def test_photos_get_the_mean_exposure() -> None:
    learned, generator = ColourTransforms(2), torch.Generator().manual_seed(0)
    for part in learned.parameters():
        part.data = 0.1 * torch.randn(part.shape, generator=generator)
    rgb = 0.2 + 0.5 * torch.rand(6, 8, 3, generator=generator)
    view = photo(1.0)
    taken = [learned(rgb.view(-1, 3), torch.full((48,), number)).view(6, 8, 3).detach() for number in range(2)]
    views = [replace(view, frame=replace(view.frame, rgb=each)) for each in taken]
    for found in of_mean_exposure(views, learned.state_dict()):
        torch.testing.assert_close(found.frame.rgb, rgb, atol=6e-3, rtol=0)


# Training.


@pytest.mark.usefixtures("blobs")
def test_steps_are_divided_among_the_overview_and_the_cells(tmp_path: Path) -> None:
    config = {"inner": "blobs", "steps": 29, "overview_share": 0.2}
    options = bn.TrainOptions(refine_poses="never")
    scene = bn.train(tiny.views(), "cells", tmp_path / "map", config, bake=False, options=options)
    field: Any = scene.field
    assert scene.info.complete
    assert field.overview.steps == 6
    assert sorted(int(cell.steps) for cell in field.cells) == [5, 6, 6, 6]
    assert field.trained.all()


def test_a_map_of_cells_is_stored_and_scaled(tmp_path: Path) -> None:
    config = {"inner_settings": list(INNER), "steps": 20, "overview_share": 0.2}
    scene = bn.train(tiny.views(), "cells", tmp_path / "map", config, bake=False)
    view = tiny.views()[0]
    before, after = scene.render(view), bn.load_map(tmp_path / "map").render(view)
    assert torch.equal(before.rgb, after.rgb)
    larger = scene.scaled(2.0)
    T = SE3(view.T_ref_camera.rotation, 2 * view.T_ref_camera.translation)
    torch.testing.assert_close(larger.render(replace(view, T_ref_camera=T)).rgb, before.rgb, atol=1e-4, rtol=0)


@pytest.mark.slow
def test_cells_are_the_same_trained_in_other_processes_and_after_an_interruption() -> None:
    config = CellsConfig(inner_settings=INNER, steps=18, overview_share=0.2)

    def train(report: Recorder) -> CellsField:
        field = backend.build(config, SCENE_BOUNDS)
        backend.train(field, rgbd_views(), config, report)
        return field

    fields, stopped = [train(Recorder())], Recorder(stop=10)
    with bn.cluster(2):
        fields.append(train(Recorder()))
        with pytest.raises(TrainingStopped) as stop:
            train(stopped)
        (state,) = stopped.saved
        assert state.step == stop.value.step == config.ends(8)[4]  # the cell that was in work is finished
        assert state.field["trained"].sum() == 4
        fields.append(train(Recorder(state=state)))
    first, *others = (field.state_dict() for field in fields)
    for other in others:
        for name, value in first.items():
            assert torch.equal(other[name], value), name
