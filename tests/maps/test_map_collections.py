"""Several maps at once: which one an image shows, and the runner-up."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock, patch

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import bidnerf as bn

# Inside: a worker of the service without its processes
import bidnerf_core.maps.collection as collections_module
from bidnerf.scenes import orbit
from bidnerf.service import Upload
from bidnerf.service.worker import LoadedMaps
from bidnerf.testing import BOUNDS, GROUND_CAMERA, POSES, ground
from bidnerf.testing import textured_view as view
from bidnerf_core.camera import CameraSource
from bidnerf_core.captures import stored_cameras
from bidnerf_core.fields import NoField
from bidnerf_core.mapping import BakeConfig, Sift, bake, build_landmarks
from bidnerf_core.maps import Map, MapInfo, maps_in, name_maps
from bidnerf_core.maps.collection import Ballot
from commands import Run
from localizations import answer
from optional import require
from refusals import refused

SEEDS = (0, 4)


def photo(seed: int) -> bn.View:
    """Return an unseen image of a ground, without depth."""
    image = view(POSES[1], "unseen", seed)
    return replace(image, frame=replace(image.frame, depth=None))


@pytest.fixture(scope="module")
def grounds() -> list[Map]:
    """Two grounds of other textures, of six images each, and one of which no landmarks are known."""
    found = []
    for seed in SEEDS:
        images = [view(T, f"{n:04d}", seed) for n, T in enumerate(orbit(1.8, 10, elevation=(45, 75), seed=0)[:6])]
        info = MapInfo(
            "ground", {}, BOUNDS, 1, True, f"ground{seed}", weights=f"g{seed}", cameras=stored_cameras(images)
        )
        surface = bake(ground(seed), BOUNDS, [], images, BakeConfig(cells=20_000))
        found.append(Map(info, ground(seed), surface, build_landmarks(images)))
    return [*found, replace(found[1], landmarks=None, info=replace(found[1].info, data="bare"))]


@pytest.mark.slow
def test_the_map_that_an_image_shows_is_found(grounds: list[Map]) -> None:
    maps = bn.MapCollection(grounds, limit=2)
    assert maps.names == ("ground0", "ground4", "bare")
    image = photo(SEEDS[1])
    found = maps(image.frame)
    assert (found.map, found.converged) == ("ground4", True)
    assert next(iter(found.ranking)) == found.map
    # Far more keypoints vote for it than for the other, which is not tried; of each image, keypoints are detected once.
    assert (found.tried, found.runner_up) == (("ground4",), None)
    assert found.ranking["ground4"] > 0.9
    assert found.ranking["ground0"] < 0.3 * found.ranking["ground4"]
    assert found.ranking["bare"] == -1
    with patch.object(Sift, "__call__", autospec=True, side_effect=Sift.__call__) as detecting:
        maps(photo(SEEDS[1]).frame)
    assert detecting.call_count == 1
    alone = bn.Localizer(grounds[1], warm_up=False)(image.frame)
    assert torch.equal(found.found.T_world_camera.matrix(), alone.T_world_camera.matrix())


def test_transparent_pixels_show_the_background_of_the_map(grounds: list[Map], tmp_path: Path) -> None:
    """The background is that of whichever map a photo is tried in, unless the user names another."""
    rgb, alpha = photo(SEEDS[0]).frame.rgb.numpy(), np.zeros((GROUND_CAMERA.height, GROUND_CAMERA.width, 1), np.float32)
    alpha[: GROUND_CAMERA.height // 2] = 1.0
    rgba = (255 * np.concatenate([rgb, alpha], axis=-1)).round().astype(np.uint8)
    iio.imwrite(tmp_path / "cut.png", rgba)
    for background in ((0.0, 0.0, 0.0), (1.0, 0.5, 0.25)):
        info = replace(grounds[0].info, bounds=replace(BOUNDS, background=background))
        localizer = bn.Localizer(replace(grounds[0], info=info), warm_up=False)
        behind = (alpha * rgb + (1 - alpha) * np.float32(background))[-1, -1]
        for frame in (
            bn.Frame.open(tmp_path / "cut.png", camera=GROUND_CAMERA),
            bn.Frame.from_numpy(rgba, GROUND_CAMERA),
            bn.Frame.read(tmp_path / "cut.png", CameraSource(GROUND_CAMERA), background=background),
        ):
            (seen,) = localizer.problem(frame).views
            np.testing.assert_allclose(seen.frame.rgb[-1, -1], behind, atol=1 / 255)
    white = bn.Frame.read(tmp_path / "cut.png", CameraSource(GROUND_CAMERA), background="white")
    assert float(bn.Localizer(grounds[0], warm_up=False).problem(white).views[0].frame.rgb[-1, -1].min()) == 1


def test_a_map_without_a_field_is_found_by_its_landmarks(grounds: list[Map]) -> None:
    """Among maps with fields, a map that is imported from COLMAP has none."""
    alone = Map(replace(grounds[1].info, data="alone"), NoField(), None, grounds[1].landmarks)
    found = bn.MapCollection([grounds[0], alone])(photo(SEEDS[1]).frame)
    assert (found.map, found.converged) == ("alone", True)
    # Two maps of one place get the same votes, and both are tried.
    rival = bn.MapCollection([grounds[1], alone])(photo(SEEDS[1]).frame)
    name, second = require(rival.runner_up)
    assert second.converged
    assert {rival.map, name} == {"ground4", "alone"}
    assert rival.ranking["alone"] == rival.ranking["ground4"] > 0.9


@pytest.mark.slow
def test_the_service_finds_the_map_of_a_photo(grounds: list[Map], tmp_path: Path) -> None:
    """Under the names by which the maps are served, and with the localizers that serve them."""
    localizers = {name: bn.Localizer(scene, warm_up=False) for name, scene in zip("ab", grounds, strict=False)}
    worker = LoadedMaps(localizers, 1e6)
    assert require(worker.together).localizer("b") is localizers["b"]
    assert LoadedMaps({"a": localizers["a"]}, 1e6).together is None
    png = iio.imwrite("<bytes>", (255 * photo(SEEDS[1]).frame.rgb).byte().numpy(), extension=".png")
    task = {"map": None, "upload": Upload({"name": "<i>", "focal": GROUND_CAMERA.fx}, {"photo": png})}
    reply = worker.answer(task, tmp_path)
    assert reply["status"] == 200, reply
    body = reply["body"]
    assert (body["frame"], body["map"], body["converged"]) == ("<i>", "b", True)
    assert body["runner_up"] is None
    alone = worker.answer(task | {"map": "b"}, tmp_path)["body"]
    assert alone["T_world_camera"] == body["T_world_camera"]


def test_what_looks_alike_in_many_maps_has_no_vote() -> None:
    """Forty maps show the same furniture; each has pictures of its own, but for two maps of one room."""
    generator = torch.Generator().manual_seed(0)
    shape = (42, 60, 128)
    furniture, *pictures = torch.randint(60, shape, generator=generator).byte()
    pictures[7] = pictures[8]
    ballot = Ballot.of([torch.cat([furniture, own]) for own in pictures[:40]])
    assert float(ballot.shares(furniture, 40).max()) == 0
    assert ballot.shares(torch.cat([furniture, pictures[3]]), 40).nonzero().tolist() == [[3]]
    assert ballot.shares(pictures[8], 40).tolist() == [float(number in (7, 8)) for number in range(40)]
    assert float(ballot.shares(pictures[40], 40).max()) < 0.1  # of a room in no map


def test_maps_without_landmarks_come_last(grounds: list[Map]) -> None:
    maps = bn.MapCollection([grounds[2], grounds[0]])
    assert list(maps.rank(view(POSES[1]).frame)) == ["ground0", "bare"]
    dark = bn.Frame.from_numpy(np.zeros((96, 128, 3), np.uint8), GROUND_CAMERA)
    assert set(maps.rank(dark).values()) == {-1.0}


def test_the_limit_counts_only_maps_that_can_be_compared(grounds: list[Map], monkeypatch: pytest.MonkeyPatch) -> None:
    """Maps without landmarks cannot be ranked, so that any of them may be the one that the image shows."""
    bare = {f"bare{n}": grounds[2] for n in range(7)}
    maps = bn.MapCollection({**bare, "ground0": grounds[0], "ground4": grounds[1]}, limit=1)
    none = answer(outcome=bn.Outcome.TOO_FEW_MATCHES)
    monkeypatch.setattr(maps, "_in_map", lambda *_, **__: none)
    assert maps(photo(SEEDS[1]).frame).tried == ("ground4", *bare)
    assert set(maps(bn.Frame.from_numpy(np.zeros((96, 128, 3), np.uint8), GROUND_CAMERA)).tried) == set(maps.names)


def test_what_is_no_map_is_refused(grounds: list[Map], tmp_path: Path) -> None:
    with refused(where=tmp_path, found="no map in it", expected="a map or a folder of maps"):
        bn.MapCollection(tmp_path)
    with refused(found="two maps are named 'ground0'", expected="each map once"):
        bn.MapCollection([grounds[0], grounds[0]])
    with refused(found="no map 'x'", expected="one of ground0"):
        bn.MapCollection(grounds[:1]).localizer("x")
    assert maps_in(tmp_path / "none") == []


def test_folders_of_one_name_are_told_apart_by_those_around_them(
    grounds: list[Map], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(collections_module, "load_info", lambda _: grounds[0].info)
    monkeypatch.setattr(collections_module, "read_part", lambda *_: None)
    folders = [tmp_path / name for name in ("A/day/MAP", "B/day/MAP", "B/night/MAP", "B/other")]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "map.json").write_text("{}")
    named = {"A/day/MAP", "B/day/MAP", "night/MAP", "other", "ground0"}
    assert set(bn.MapCollection([*folders, grounds[0]]).names) == named
    memory = replace(grounds[0], info=replace(grounds[0].info, data="other"))
    assert bn.MapCollection([folders[-1], memory]).names == ("B/other", "ground/other")
    trained_again = replace(memory, info=replace(memory.info, backend="other"))
    assert list(name_maps([memory, trained_again])) == ["ground/other", "other/other"]
    assert list(name_maps([memory, replace(memory)])) == ["ground/other", "ground/other-2"]
    with refused(found="two maps are named 'MAP'", expected="each map once"):
        bn.MapCollection([folders[0], folders[1], folders[0]])
    (tmp_path / "today").symlink_to(folders[0])
    assert list(name_maps([tmp_path / "today", folders[-1]])) == ["today", "other"]  # a link keeps its own name
    with refused(found="two maps are named 'MAP'", expected="each map once"):
        name_maps([tmp_path / "today", folders[0]])


def test_the_command(bidnerf: Run, grounds: list[Map], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Folders of maps, whose landmarks are read, and of which only those that are asked are loaded."""
    known = dict(zip(("m0", "m4", "bare"), grounds, strict=True)) | {"again": grounds[1]}
    load = Mock(side_effect=lambda folder, device="cpu": known[folder.name])
    monkeypatch.setattr(collections_module, "load_info", lambda folder: known[folder.name].info)
    monkeypatch.setattr(collections_module, "read_part", lambda folder, info, part: known[folder.name].landmarks)
    monkeypatch.setattr(collections_module, "load_map", load)
    for name in known:
        folder = tmp_path / ("other" if name == "again" else "maps") / name
        folder.mkdir(parents=True)
        (folder / "map.json").write_text("{}")
    file = tmp_path / "photo.png"
    iio.imwrite(file, (255 * view(POSES[1], "", SEEDS[1]).frame.rgb).round().to(torch.uint8).numpy())
    out = bidnerf("localize", tmp_path / "maps", file, "--focal", 130, "--json").succeed().out
    found = json.loads(out)
    assert (found["map"], found["converged"]) == ("m4", True)
    assert found["runner_up"] is None
    assert found["similarity"] > 0.9
    assert load.call_count == 1
    two = (tmp_path / "other" / "again", tmp_path / "maps" / "m4")
    out = bidnerf("localize", *two, file, "--focal", 130, "--out", tmp_path / "poses.json").succeed().out
    assert out.startswith("photo: in again: accepted")
    assert "runner-up m4: accepted" in out
    assert json.loads((tmp_path / "poses.json").read_text())[0]["map"] == "again"
    for words in (("--out", tmp_path / "poses.txt"), ("--perturb", 1, 1)):
        assert bidnerf("localize", *two, file, *words)[0] == 2
