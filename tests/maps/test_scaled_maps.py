"""Maps in another unit: everything scales together, and scaling back gives the same map."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import bidnerf as bn
import tiny
from bidnerf.results import read_positions
from bidnerf.testing import BOUNDS, GROUND_CAMERA, textured_map, unseen
from bidnerf_core.captures import stored_cameras
from bidnerf_core.fields import levels
from bidnerf_core.frames import SeenLandmarks
from bidnerf_core.io import FileInUse, lock
from bidnerf_core.localization import Loop

# Inside: the place of a map by its name
from bidnerf_core.maps import Anchor, Map, MapInfo, factor_of_distance, factor_of_poses, load_info
from bidnerf_core.maps.known_lengths import locate_point
from bidnerf_core.maps.views import scaled_view, views_again
from commands import Run, assert_refused
from optional import require
from refusals import refused


@pytest.fixture(scope="module")
def ground() -> Map:
    """The textured ground as a map of three cameras, in units of unknown length."""
    known, view = textured_map(surface=True), unseen()
    moves = torch.eye(3, 6, dtype=torch.float64)
    views = [
        bn.View(replace(view.frame, name=f"c{n}"), view.T_ref_camera.retract(move)) for n, move in enumerate(moves)
    ]
    info = MapInfo("ground", {}, BOUNDS, 1, True, "data", weights="ground", cameras=stored_cameras(views))
    return Map(info, known.field, known.surface, known.landmarks)


@pytest.mark.slow
def test_all_that_is_computed_scales(ground: Map) -> None:
    view, large = unseen(), ground.scaled(4.0)
    assert (ground.unit, large.unit) == ("units", "metres")
    there = bn.View(view.frame, bn.SE3(view.T_ref_camera.rotation, 4 * view.T_ref_camera.translation))
    before, after = ground.render(view), large.render(there)
    torch.testing.assert_close(after.rgb, before.rgb, atol=2e-4, rtol=0)
    torch.testing.assert_close(after.depth, 4 * before.depth, atol=1e-3, rtol=1e-4)
    found, scaled = (bn.Localizer(scene, warm_up=False)(view.frame) for scene in (ground, large))
    assert found.converged
    assert scaled.converged
    assert (found.unit, scaled.unit) == ("units", "metres")
    off = scaled.T_world_camera.translation - 4 * found.T_world_camera.translation
    assert float(off.norm()) < 1e-3
    assert len(levels(large.field)) == len(levels(ground.field))


@pytest.mark.slow
def test_scaling_back_gives_the_same_answers(ground: Map) -> None:
    """To the last bit for a power of two, whose products are exact."""
    back = ground.scaled(0.5).scaled(2.0, "units")
    assert back.info == ground.info
    assert torch.equal(back.render(unseen()).rgb, ground.render(unseen()).rgb)
    before, after = (bn.Localizer(scene, warm_up=False)(unseen().frame) for scene in (ground, back))
    assert torch.equal(after.T_world_camera.matrix(), before.T_world_camera.matrix())
    assert torch.equal(require(after.covariance), require(before.covariance))


def test_a_known_length_gives_the_factor(ground: Map) -> None:
    assert factor_of_distance(ground, "c0", "c1", 2.8284271247) == pytest.approx(2)
    assert factor_of_distance(ground, "0,0,0", (0.0, 3.0, 4.0), 1.0) == pytest.approx(0.2)
    low, high = (f"c0@{0.25 * GROUND_CAMERA.width},{y * GROUND_CAMERA.height}" for y in (0.4, 0.6))
    apart = factor_of_distance(ground, low, high, 1.0)
    assert factor_of_distance(ground.scaled(0.5), low, high, 1.0) == pytest.approx(2 * apart, rel=1e-3)
    assert factor_of_distance(ground, "0", "1.png", 2.8284271247) == pytest.approx(2)  # endings of one name each
    for bad, found, instead in (
        ("nobody", "no place 'nobody' in the map: none of its 3 cameras", "a name such as 'c0'"),
        ("1,2", "no place '1,2' in the map: none of its 3 cameras", "coordinates X,Y,Z"),
        ("1,2,3,nan", "no place '1,2,3,nan' in the map: none of its 3 cameras", "coordinates X,Y,Z"),
        ("1,2,nan", "no place '1,2,nan' in the map: none of its 3 cameras", "coordinates X,Y,Z"),
        ("c0@1", "no place 'c0@1' in the map: none of its 3 cameras is called 'c0'", "NAME@U,V"),
        ("c7.png", "no place 'c7.png' in the map: none of its 3 cameras", "held out for tests"),
        ("c0@-3,1", "pixel -3,1 is outside c0", "128x96"),
        ("c1", "c1 and c1", "the same place"),
    ):
        with refused(found=found) as caught:
            factor_of_distance(ground, bad, "c1", 1.0)
        assert instead in caught.error.found
    assert factor_of_distance(ground, "c0.png", "c1.JPG", 2.8284271247) == pytest.approx(2)
    file, name = f"c0.png@{0.25 * GROUND_CAMERA.width},1", f"c0@{0.25 * GROUND_CAMERA.width},1"
    assert torch.equal(locate_point(ground, file), locate_point(ground, name))


def test_known_poses_give_the_factor(ground: Map) -> None:
    """In any world: only the distances of the cameras count."""
    T_other_world = bn.SE3.exp(torch.tensor([3.0, -2, 1, 0.5, 1.0, -0.3], dtype=torch.float64))
    known = {
        camera.name: T_other_world @ bn.SE3(camera.pose.rotation, 3 * camera.pose.translation)
        for camera in ground.info.cameras
    }
    fit = factor_of_poses(ground, known | {"elsewhere": bn.SE3.identity()})
    assert fit.factor == pytest.approx(3)
    assert (fit.cameras, fit.error) == (3, pytest.approx(0, abs=1e-9))
    with refused(found="1 of 1 known poses", expected="at least 3"):
        factor_of_poses(ground, {"c0": known["c0"]})
    wrong = {
        name: bn.SE3(known["c0"].rotation, torch.tensor([x, 0.0, 0.0]).double())
        for name, x in (("c0", 0), ("c1", 1), ("c2", 9))
    }
    with refused(found="m (root mean square)", expected="known positions of the same capture"):
        factor_of_poses(ground, wrong)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (4e5, -2e5, 100.0)])
def test_images_in_the_unit_of_before_are_scaled_as_their_map_was(origin: tuple[float, float, float]) -> None:
    """Also those whose poses training had refined; images in the unit of the map stay as they are."""
    offset, view = torch.tensor(origin, dtype=torch.float64), unseen()
    moves = torch.eye(3, 6, dtype=torch.float64)
    given = [bn.View(view.frame.replace(name=f"c{n}"), view.T_ref_camera.retract(move)) for n, move in enumerate(moves)]
    refined = [replace(v, T_ref_camera=v.T_ref_camera.retract(0.01 * moves[0])) for v in given]
    both = zip(stored_cameras(given), stored_cameras(refined), strict=True)
    cameras = tuple(replace(after, given_T_world_camera=before.T_world_camera) for before, after in both)
    info = MapInfo("ground", {}, BOUNDS, 1, True, "data", weights="ground", cameras=cameras, origin=origin)
    in_world = [replace(v, T_ref_camera=v.T_ref_camera.translated(offset)) for v in given]
    large = info.scaled(2.5, "metres")
    in_metres = [
        replace(v, T_ref_camera=bn.SE3(v.T_ref_camera.rotation, 2.5 * v.T_ref_camera.translation)) for v in in_world
    ]
    for views, factor in ((in_world, 2.5), (in_metres, 1.0)):
        read, posed = views_again(large, views)
        for one, other in zip(read.views, given, strict=True):
            expected = 2.5 * other.T_ref_camera.translation
            torch.testing.assert_close(one.T_ref_camera.translation, expected, atol=1e-6, rtol=0)
            torch.testing.assert_close(require(one.frame.depth), factor * require(other.frame.depth))
        assert [v.T_ref_camera.matrix().tolist() for v in posed] == [c.pose.matrix().tolist() for c in large.cameras]
    assert views_again(info, in_world)[0].views[0].frame is in_world[0].frame


def test_all_lengths_of_a_view_are_scaled() -> None:
    view, seen = unseen(), SeenLandmarks(torch.ones(2, 2), torch.tensor([1.0, 2.0]), torch.tensor([0.1, 0.2]))
    motion = torch.tensor([1.0, 2.0, 3.0, 0.1, 0.2, 0.3], dtype=torch.float64)
    large = scaled_view(replace(view, landmarks=seen, motion=motion), 2.0)
    assert require(large.motion).tolist() == pytest.approx([2.0, 4.0, 6.0, 0.1, 0.2, 0.3])
    assert require(large.landmarks).distance.tolist() == [2.0, 4.0]
    torch.testing.assert_close(require(large.landmarks).deviation, 2 * seen.deviation)
    torch.testing.assert_close(require(large.frame.depth), 2 * require(view.frame.depth))


def test_a_map_in_metres_that_is_scaled_again_is_remarked(ground: Map, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "bidnerf")
    metric = ground.scaled(2.0)
    metric.scaled(1.0)
    assert not caplog.text
    metric.scaled(2.0)
    assert "was in metres before; its lengths are multiplied by 2 all the same" in caplog.text


def test_known_positions_come_from_a_file(ground: Map, tmp_path: Path) -> None:
    known, file = {c.name: 3 * c.pose.translation for c in ground.info.cameras}, tmp_path / "known.json"
    file.write_text(json.dumps({f"{name}.jpg": place.tolist() for name, place in known.items()}))
    assert factor_of_poses(ground, read_positions(file)).factor == pytest.approx(3)
    poses = [{"frame": c.name, "T_world_camera": c.pose.matrix().tolist()} for c in ground.info.cameras]
    by_name = {pose["frame"]: pose["T_world_camera"] for pose in poses}
    for content in (json.dumps(poses), "\n".join(map(json.dumps, poses)), json.dumps(by_name)):
        file.write_text(content)
        assert factor_of_poses(ground, read_positions(file)).factor == pytest.approx(1)
    form = '{"NAME": [x, y, z], ...} or [{"frame": "NAME", "T_world_camera": 4x4 rows}, ...]'
    for wrong in (
        '{"c0": [1, 2]}',
        '{"frames": [{"file_path": "c0"}]}',
        "[[1, 2, 3]]",
        "[]",
        '{"c0": [1, 2, "3"]}',
        "c0 1 2 3",
    ):
        file.write_text(wrong)
        with refused(where=file) as caught:
            read_positions(file)
        assert caught.error.expected == form


@pytest.mark.parametrize("factor", [0, -1.0, float("nan"), float("inf"), 1e300, "2", True])
def test_a_factor_is_a_positive_number(ground: Map, factor: float) -> None:
    with refused(found=f"factor is {factor!r}"):
        ground.scaled(factor)


def test_an_interrupted_training_is_not_scaled(ground: Map) -> None:
    with refused(where="data", found="cannot be scaled: its training has not ended (step 1 is saved)"):
        replace(ground, info=replace(ground.info, complete=False)).scaled(2)


@pytest.mark.parametrize("noise", [None, 0.01])
def test_a_field_whose_training_is_unfinished_is_not_rendered(ground: Map, noise: float | None) -> None:
    """Rendering costs more than it tells there; landmarks localize alone."""
    for complete, rays in ((True, 64), (False, 0)):
        scene = replace(ground, info=replace(ground.info, complete=complete, colour_noise=noise))
        localizer = bn.Localizer(scene, warm_up=False)
        problem = localizer.problem(unseen().frame)
        assert Loop([unseen()], require(localizer.matcher), problem, rays=64).rays == rays


def test_a_map_that_is_being_changed_is_not_read(bidnerf: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What another process writes between reading and writing would be lost."""
    bn.train(tiny.views(3), out=tmp_path / "map", config=tiny.config(2), bake=False)
    refused, read = list[str](), bn.load_map

    def load(folder: Path, device: str = "cpu") -> Map:
        with pytest.raises(FileInUse) as found, lock(folder):
            pass
        refused.append(str(found.value))
        return read(folder)

    monkeypatch.setattr("bidnerf_core.maps.load_map", load)
    assert bidnerf("scale", tmp_path / "map", "--factor", "2", "--overwrite")[0] == 0
    monkeypatch.setattr("bidnerf_core.maps.extending.load_map", load)
    bidnerf("extend", tmp_path / "map", tmp_path)
    assert len(refused) == 2
    nothing = bidnerf("scale", tmp_path / "none", "--factor", "2")
    assert (nothing.status, "none" in nothing.err, (tmp_path / "none").exists()) == (1, True, False)


def test_the_command(bidnerf: Run, tmp_path: Path) -> None:
    trained = tmp_path / "map"
    before = bn.train(tiny.views(3), out=trained, config=tiny.config(5), bake=False)
    tiny.write_anchor(trained, anchor := Anchor(47.0, 19.0, 100.0, metres_per_unit=0.5))
    out = bidnerf("scale", trained, "--factor", "0.5", "--out", tmp_path / "half").succeed().out
    assert "all lengths multiplied by 0.5" in out
    half = bn.load_map(tmp_path / "half")
    assert half.unit == "metres"
    assert load_info(tmp_path / "half").anchor == replace(anchor, metres_per_unit=1.0)
    assert half.bounds.side == 0.5 * before.bounds.side
    names = [camera.name for camera in before.info.cameras]
    length = float((before.info.cameras[0].pose.translation - before.info.cameras[1].pose.translation).norm())
    bidnerf("scale", tmp_path / "half", "--distance", names[0], names[1], length).succeed()
    back = bn.load_map(tmp_path / "half")
    assert back.bounds.side == pytest.approx(before.bounds.side)
    view = before.info.cameras[0]
    assert view.pose.translation.tolist() == pytest.approx(back.info.cameras[0].pose.translation.tolist())
    assert bidnerf("scale", tmp_path / "half")[0] == 2
    metric = replace(before, info=replace(before.info, unit="metres")).save(tmp_path / "metric")
    again = "scale", metric.folder, "--factor", 2
    assert_refused(
        bidnerf(*again), 1, metric.folder, "is in metres by its data", "multiplied by 2", "--out", "--overwrite"
    )
    bidnerf(*again, "--overwrite").succeed()
    assert_refused(
        bidnerf("scale", trained, "--factor", 2, "--out", tmp_path / "half"), 1, "exists already", "--overwrite"
    )
    assert bidnerf("scale", tmp_path / "half", "--factor", "-1")[0] == 2
