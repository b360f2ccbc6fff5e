"""Importing a trained field: who reads a file, what is told about it, and from where it is looked at."""

from __future__ import annotations

import functools
import logging
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

import tiny
from bidnerf import import_map, load_map
from bidnerf.cli import main
from bidnerf.scenes import demo_object
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import DatasetOptions, write_transforms
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.fields import FieldValues, RayHits, Rays, SceneBounds, Stratified
from bidnerf_core.geometry import SE3, Similarity
from bidnerf_core.maps import ImportedField, ImportOptions, bounds_about, importer_of

# Inside: viewpoints of given fields and bounds, whose number a map does not state
from bidnerf_core.maps.importing import VIEWS, viewpoints
from bidnerf_core.registry import registered
from bidnerf_core.training import Silent
from bidnerf_hashgrid import backend
from refusals import refused

FEW = 12


@functools.cache
def trained() -> dict[str, Tensor]:
    """Return the weights of a field that others might have trained."""
    field = backend.build(tiny.config(40), demo_object().bounds)
    backend.train(field, tiny.views(), tiny.config(40), Silent())
    return dict(field.state_dict())


@dataclass(frozen=True)
class TinySettings:
    size: float = 1.0  # factor on the extent that is told


@dataclass(frozen=True)
class TinyImporter:
    """Files that end in .tiny."""

    summary: str = "files that end in .tiny"
    config_type: type = TinySettings

    def recognises(self, path: Path) -> bool:
        return path.suffix == ".tiny"

    def read(self, path: Path, config: TinySettings, placement: Similarity) -> ImportedField:
        if not placement.is_identity:
            raise InputError(f"cannot be moved by {placement.scale}", where=path)
        bounds = demo_object().bounds
        points = config.size * torch.tensor([bounds.lower, bounds.upper]).repeat(200, 1)
        return ImportedField(
            "hashgrid", tiny.config(40), trained(), bounds, found=("3 things",), steps=40, points=points
        )


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file that exactly one importer reads; where it has no photos, the field is seen from few places."""
    monkeypatch.setitem(registered, ("importers", "tiny"), TinyImporter())
    for name, value in (("VIEWS", FEW), ("RENDERED_CAMERA", Intrinsics.from_hfov(70, 32, 32))):
        monkeypatch.setattr(f"bidnerf_core.maps.importing.{name}", value)
    path = tmp_path / "field.tiny"
    path.touch()
    return path


def test_a_file_becomes_a_map(file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, "bidnerf"):
        scene = import_map(file, tmp_path / "MAP", bake=False)
    assert "3 things" in caplog.text
    assert "its unit is not stored" in caplog.text
    assert scene.unit == "units"
    assert f"{FEW} viewpoints" in caplog.text
    again = load_map(tmp_path / "MAP")
    assert "training:    none here: imported as a field of backend hashgrid" in str(again.describe())
    with refused(where=tmp_path, expected=f"such as {tmp_path / 'MAP'} in it"):
        load_map(tmp_path)
    with refused(where=file, found="`images` names a folder, but no dataset", expected="`photos`"):
        import_map(file, bake=False, options=ImportOptions(DatasetOptions(images=tmp_path)))
    assert again.info.complete
    assert again.info.data == "field.tiny"
    assert again.info.cameras == scene.info.cameras
    assert all(torch.equal(value, trained()[name]) for name, value in again.field.state_dict().items())  # type: ignore[attr-defined]


def test_without_photos_it_is_baked_from_renderings(file: Path) -> None:
    scene = import_map(file)
    assert scene.surface is not None
    assert scene.folder is None
    assert len(scene.info.cameras) == FEW


def test_photos_give_the_cameras(file: Path) -> None:
    photos = tiny.views(5, seed=2)
    scene = import_map(file, photos=photos, bake=False)
    assert [camera.name for camera in scene.info.cameras] == [view.frame.name for view in photos]
    other = [replace(v, frame=replace(v.frame, rgb=1 - v.frame.rgb, alpha=None)) for v in photos]
    with refused(where=file, found="built from 'field.tiny'", expected="photos of the same scene"):
        import_map(file, photos=other, bake=False)


def test_photos_that_the_file_names(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """They are used where no others are given and, where they cannot be read, left aside with a word."""
    write_transforms(tmp_path / "photos", {"train": tiny.views(5, seed=2)}, demo_object().bounds.background)
    read = TinyImporter.read
    for folder, names in (("photos", [view.frame.name for view in tiny.views(5, seed=2)]), ("none", None)):
        monkeypatch.setattr(TinyImporter, "read", lambda *given, f=tmp_path / folder: replace(read(*given), photos=f))
        with caplog.at_level(logging.INFO, "bidnerf"):
            found = [camera.name for camera in import_map(file, bake=False).info.cameras]
        assert found == names or (names is None and len(found) == FEW)
    assert "its training images cannot be read" in caplog.text


def test_depth_in_another_unit_is_told(file: Path) -> None:
    far = [replace(v, frame=replace(v.frame, depth=3 * v.frame.depth)) for v in tiny.views(5, seed=2)]
    with pytest.warns(InputWarning, match="times the field's"):
        import_map(file, photos=far, bake=False)


def test_lengths_that_are_hardly_metres_are_told(file: Path) -> None:
    for size, word in ((1000.0, "very large"), (0.001, "tiny")):
        with pytest.warns(InputWarning, match=word):
            import_map(file, config={"size": size}, bake=False)


def test_who_reads_a_file(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert importer_of(file)[0] == "tiny"
    with refused(where=tmp_path / "none.tiny", found="no such file", expected="a trained field"):
        importer_of(tmp_path / "none.tiny")
    (tmp_path / "a.txt").touch()
    with refused(where=tmp_path / "a.txt", found="tiny reads files that end in .tiny"):
        importer_of(tmp_path / "a.txt")
    assert importer_of(tmp_path / "a.txt", "tiny")[0] == "tiny"
    monkeypatch.setattr("bidnerf_core.maps.importers.OFFERED", {"tiny": "tiny files", "absent": "splats"})
    with refused(
        where=tmp_path / "a.txt", found="); in a clone of bidnerf, pip install ./plugins/bidnerf-absent for splats"
    ):
        importer_of(tmp_path / "a.txt")
    pointer = tmp_path / "scene.ply"
    pointer.write_text("version https://git-lfs.github.com/spec/v1\n")
    with refused(where=pointer, found="is a pointer of Git LFS, not the file", expected="git lfs pull"):
        importer_of(pointer)
    monkeypatch.setitem(registered, ("importers", "twin"), TinyImporter())
    with refused(where=file, found="tiny and twin can each read it"):
        importer_of(file)
    with refused(found="no importer 'tin'"):
        importer_of(file, "tin")


def test_scale_and_pose_reach_the_importer(file: Path) -> None:
    with refused(where=file, found="moved by 2.0"):
        import_map(file, options=ImportOptions(scale=2.0))
    turned = SE3.exp(torch.tensor([0, 0, 0, 0, 0, 1.0], dtype=torch.float64))
    with refused(where=file, found="moved by 1.0"):
        import_map(file, options=ImportOptions(T_world_file=turned))
    for scale in (0.0, -1.0, float("nan")):
        with refused(found=f"scale is {scale}", expected="more than 0"):
            import_map(file, options=ImportOptions(scale=scale))


def test_the_command(file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "MAP")
    assert main(["import", str(file), "--out", out, "--no-bake", "--size", "2"]) == 0
    assert "3 things" in capfd.readouterr().err
    assert main(["import", str(file), "--out", out, "--no-bake"]) == 1  # there is a map already
    assert main(["import", str(file), "--out", out, "--no-bake", "--overwrite", "--sise", "2"]) == 2
    assert main(["import", str(tmp_path / "none"), "--out", out]) == 1
    assert "no such file" in capfd.readouterr().err


def test_bounds_hold_nearly_all_matter() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand((4000, 3), generator=generator)
    near = bounds_about(points)
    assert not near.contracted
    assert near.side == pytest.approx(1.1, abs=0.05)
    sky = 100 * torch.nn.functional.normalize(torch.randn((300, 3), generator=generator), dim=-1)
    wide = bounds_about(torch.cat([points, 0.1 * sky, sky]))
    assert wide.contracted
    assert wide.far > 100


def test_bounds_move_with_matter() -> None:
    points = torch.rand((4000, 3), generator=torch.Generator().manual_seed(0))
    here, there = (bounds_about(points + offset) for offset in (-0.5, 7.5))
    assert (there.near, there.far) == pytest.approx((here.near, here.far), rel=1e-5)
    assert there.lower == pytest.approx([x + 8 for x in here.lower], abs=1e-5)


@dataclass(frozen=True)
class Shell:
    """A sphere of radius 1 that is opaque from inside and from outside."""

    sampler: Stratified = Stratified(8)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        return FieldValues(torch.zeros_like(positions[..., 0]), torch.ones_like(positions))

    def hits(self, rays: Rays) -> RayHits:
        along = -(rays.origins * rays.directions).sum(-1)
        square = 1 - (rays.origins + along[..., None] * rays.directions).square().sum(-1)
        half = square.clamp(min=0).sqrt()
        first = torch.where(along - half > rays.near, along - half, along + half)
        valid = ((square > 0) & (first > rays.near) & (first < rays.far))[..., None]
        distance = torch.where(valid, first[..., None], rays.near[..., None])
        return RayHits(distance, valid.float(), torch.ones((*distance.shape, 3)), valid)


def test_a_room_is_seen_from_inside_and_an_object_from_around() -> None:
    inside = viewpoints(Shell(), SceneBounds((-1, -1, -1), (1, 1, 1), 0.01, 10.0))
    assert len(inside) > VIEWS / 2
    assert all(float(camera.pose.translation.norm()) < 1 for camera in inside)
    # a box in which the shell is small: hardly any of its places is enclosed
    around = viewpoints(Shell(), SceneBounds((-4, -4, -4), (4, 4, 4), 0.01, 30.0))
    assert len(around) == VIEWS
    for camera in around:
        towards = camera.pose.rotate(torch.tensor([0.0, 0, 1], dtype=torch.float64))
        assert float(camera.pose.translation.norm()) > 4
        assert float(towards @ camera.pose.translation) < 0
