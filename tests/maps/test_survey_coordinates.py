"""Maps of captures far from the origin, as in survey coordinates: everything is as near it, and in the user's world."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import tiny
from bidnerf import (
    SE3,
    Frame,
    Localization,
    Localizer,
    Map,
    MapCollection,
    Tracker,
    View,
    export_map,
    extend,
    import_map,
    load_map,
    open_dataset,
    resume,
    train,
)
from bidnerf.results import overlay
from bidnerf.testing import POSES, training_views
from bidnerf.testing import textured_view as view
from bidnerf_core.errors import Cancelled
from bidnerf_core.geometry import Similarity
from bidnerf_core.mapping import BakeConfig
from bidnerf_core.maps import ImportedField, ImportOptions

# Inside: where a map's own coordinates begin, and what the names of its places mean
from bidnerf_core.maps.known_lengths import locate_point
from bidnerf_core.maps.views import choose_origin
from bidnerf_core.registry import registered
from optional import require
from trainings import stopping_at

ORIGIN = (500_000.0, 4_000_000.0, 100.0)
OFFSET = torch.tensor(ORIGIN, dtype=torch.float64)
SMALL = BakeConfig(cells=20_000)
MILLIMETRE = 0.001


def shifted(views: tuple[View, ...] | list[View]) -> list[View]:
    return [replace(v, T_ref_camera=v.T_ref_camera.to(torch.float64).translated(OFFSET)) for v in views]


@functools.cache
def near() -> Map:
    return train(list(training_views()), config=tiny.config(), bake=SMALL)


@functools.cache
def far() -> Map:
    return train(shifted(training_views()), config=tiny.config(), bake=SMALL)


@functools.cache
def localizers() -> tuple[Localizer, Localizer]:
    return Localizer(near(), warm_up=False), Localizer(far(), warm_up=False)


def apart(a: SE3, b: SE3) -> float:
    """The largest distance (metres) or angle (radians) between poses."""
    return float((a.inverse() @ b).log().abs().max())


def queries() -> list[Frame]:
    return [view(T, f"{number}").frame for number, T in enumerate(POSES)]


def test_only_scenes_far_from_the_origin_are_recentred() -> None:
    cube = torch.tensor([[0.0, 0, 0], [2, 2, 2]], dtype=torch.float64)
    assert choose_origin(cube + OFFSET) == ORIGIN
    assert choose_origin(cube + 900) == (0, 0, 0)  # single precision suffices
    assert choose_origin(1e6 * cube) == (0, 0, 0)  # the scene is as large as it is far away
    assert choose_origin(cube[:1] + OFFSET) == ORIGIN


def test_the_map_is_the_same_but_for_its_origin() -> None:
    assert near().origin == (0, 0, 0)
    assert far().origin == ORIGIN
    assert far().bounds.size == pytest.approx(near().bounds.size, abs=MILLIMETRE)
    a, b = near().landmarks, far().landmarks
    assert torch.allclose(require(a).positions, require(b).positions, atol=MILLIMETRE)


@pytest.mark.parametrize("depth", [False, True])
def test_localization_has_the_same_errors(depth: bool) -> None:
    one, other = localizers()
    for frame in queries()[:2]:
        shown = frame if depth else replace(frame, depth=None)
        a, b = one(shown), other(shown)
        assert (a.outcome, a.steps) == (b.outcome, b.steps)
        assert apart(a.T_world_camera.translated(OFFSET), b.T_world_camera) < MILLIMETRE


def test_starts_are_in_the_users_world(tmp_path: Path) -> None:
    start = POSES[1].retract(torch.tensor([0.02, 0, 0.01, 0.01, 0, 0], dtype=torch.float64))
    frame = queries()[1]
    a = Localizer(near(), "bid", {"max_steps": 3})(frame, start)
    b = Localizer(far(), "bid", {"max_steps": 3})(frame, start.translated(OFFSET))
    assert apart(b.poses[0], start.translated(OFFSET)) < 1e-6
    assert apart(a.T_world_camera.translated(OFFSET), b.T_world_camera) < MILLIMETRE
    b.save(tmp_path / "answer.json")
    assert apart(Localization.load(tmp_path / "answer.json").T_world_camera, b.T_world_camera) < 1e-9


def test_tracking_is_in_the_users_world() -> None:
    frames = [view(POSES[1].retract(0.01 * i * torch.ones(6, dtype=torch.float64))).frame for i in range(3)]
    one, other = map(Tracker, localizers())
    for number, frame in enumerate(frames):
        a, b = (tracker(frame, 0.1 * number) for tracker in (one, other))
        assert a.outcome == b.outcome
        assert apart(a.T_world_camera.translated(OFFSET), b.T_world_camera) < MILLIMETRE


def test_a_collection_answers_in_the_users_world() -> None:
    found = MapCollection({"far": far()}, localizers={"far": localizers()[1]})(queries()[0]).found
    assert apart(found.T_world_camera, POSES[0].translated(OFFSET)) < 0.05


def test_renderings_are_from_poses_of_the_users_world() -> None:
    seen = view(POSES[0])
    a, b = near().render(seen), far().render(shifted([seen])[0])
    assert torch.allclose(a.depth, b.depth, atol=MILLIMETRE)
    pictures = (
        overlay(near(), seen.frame, POSES[0]),
        overlay(far(), seen.frame, POSES[0].translated(OFFSET)),
    )
    assert (pictures[0] == pictures[1]).mean() > 0.99


def test_exports_are_in_the_users_world(tmp_path: Path) -> None:
    expected = require(far().landmarks).positions.double() + OFFSET
    for to in ("ply", "colmap", "transforms.json"):
        export_map(far(), tmp_path / to, to)
    for part in ("surface", "landmarks", "cameras"):
        assert b"property double x" in (tmp_path / "ply" / f"{part}.ply").read_bytes()
    poses = SE3.stack([v.T_ref_camera for v in shifted(training_views())])
    cameras = json.loads((tmp_path / "ply" / "cameras.json").read_text())
    assert [c["position"] for c in cameras] == poses.translation.tolist()
    rows = [line.split() for line in (tmp_path / "colmap" / "points3D.txt").read_text().splitlines()]
    places = torch.tensor([[float(x) for x in row[1:4]] for row in rows if row[0] != "#"], dtype=torch.float64)
    assert torch.allclose(places, expected, rtol=0, atol=1e-6)
    transforms = json.loads((tmp_path / "transforms.json" / "transforms.json").read_text())
    matrices = torch.tensor([f["transform_matrix"] for f in transforms["frames"]], dtype=torch.float64)
    assert torch.allclose(matrices[:, :3, 3], poses.translation, rtol=0, atol=1e-6)


def test_scaling_scales_the_origin() -> None:
    twice = far().scaled(2.0)
    assert twice.origin == tuple(2 * x for x in ORIGIN)
    name = far().info.cameras[0].name
    assert torch.allclose(locate_point(twice, name), 2 * locate_point(far(), name))
    place = shifted(training_views())[0].T_ref_camera.translation
    assert torch.allclose(locate_point(far(), name), place, rtol=0, atol=1e-6)


def test_a_dataset_is_trained_interrupted_resumed_and_baked(tmp_path: Path) -> None:
    folder = tiny.write_dataset(tmp_path / "data")
    unmoved = train(folder, config=tiny.config(20), bake=SMALL)
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        for row, shift in zip(frame["transform_matrix"], ORIGIN, strict=False):
            row[3] += shift
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(Cancelled):
        train(
            folder,
            out=tmp_path / "map",
            config=tiny.config(20),
            bake=False,
            **stopping_at("training", 10),
        )
    whole = resume(tmp_path / "map", folder, bake=SMALL)
    assert whole.info.complete
    assert whole.origin == ORIGIN
    again = load_map(tmp_path / "map").bake(folder, config=SMALL)
    query = open_dataset(folder).views("test")[0].frame
    a, b = Localizer(unmoved)(query), Localizer(again)(query)
    assert a.outcome == b.outcome
    assert apart(a.T_world_camera.translated(OFFSET), b.T_world_camera) < MILLIMETRE


def test_photos_are_added_where_they_were_taken() -> None:
    grown = extend(far(), queries()[1:2], steps=1)
    assert grown.origin == ORIGIN
    (new,) = grown.info.cameras[len(far().info.cameras) :]
    assert apart(new.pose.translated(OFFSET), POSES[1].translated(OFFSET)) < 0.05


class AnyImporter:
    """Files that hold the field of the near map, in whose coordinates everything is placed."""

    summary: str = "files that end in .any"
    config_type: type = type(tiny.config())

    def recognises(self, path: Path) -> bool:
        return path.suffix == ".any"

    def read(self, path: Path, config: object, placement: Similarity) -> ImportedField:
        assert torch.equal(placement.T_target_source.matrix(), torch.eye(4).double())
        field = near().field
        assert isinstance(field, torch.nn.Module)
        return ImportedField(
            "hashgrid", tiny.config(), dict(field.state_dict()), near().bounds, steps=1, cameras=near().info.cameras
        )


def test_a_field_is_imported_into_survey_coordinates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registered, ("importers", "any"), AnyImporter())
    (tmp_path / "field.any").touch()
    T = SE3.identity().to(torch.float64).translated(OFFSET)
    scene = import_map(tmp_path / "field.any", bake=False, options=ImportOptions(T_world_file=T))
    assert scene.origin == ORIGIN
    seen = view(POSES[0])
    assert torch.equal(scene.render(shifted([seen])[0]).rgb, near().render(seen).rgb)
