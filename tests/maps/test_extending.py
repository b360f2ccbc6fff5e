"""Maps that grow: new photos are located, trained on and recognised afterwards; nothing else changes the map in its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import bidnerf as bn
import tiny
from bidnerf.testing import textured_view as view
from bidnerf.testing import training_views
from bidnerf_core.captures import stored_cameras
from bidnerf_core.datasets import write_transforms
from bidnerf_core.errors import Cancelled
from bidnerf_core.mapping import BakeConfig

# Inside: the location of new photos alone, without the training that follows
from bidnerf_core.maps.extending import localize_new
from bidnerf_core.progress import job_context
from commands import Run
from optional import require
from photo_files import write_photo
from refusals import refused

STEPS = 6
BAKE = BakeConfig(rays=10_000, measured=30_000, cells=10_000)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of seven of ten images of the textured ground."""
    folder = tmp_path_factory.mktemp("extend") / "map"
    bn.train(list(training_views()[:7]), out=folder, config=tiny.config(), bake=BAKE)
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.suffix != ".lock"}


@pytest.fixture
def map_folder(stored: Path, tmp_path: Path) -> Path:
    bn.load_map(stored).save(tmp_path / "map")
    return tmp_path / "map"


def test_new_photos_are_located_and_added(map_folder: Path) -> None:
    before, new = bn.load_map(map_folder), training_views()[7:]
    after = bn.extend(map_folder, new, steps=STEPS, config=BAKE)
    few, more = (len(require(scene.landmarks)) for scene in (before, after))
    assert [camera.name for camera in after.info.cameras[7:]] == [each.frame.name for each in new]
    for camera, truth in zip(after.info.cameras[7:], new, strict=True):
        assert float((camera.pose.translation - truth.T_ref_camera.translation).norm()) < 0.03
    assert few < more < 2 * few
    assert (after.info.added, after.info.step) == (3, before.info.step + STEPS)
    assert "10 images, 3 of which were added later" in str(after.describe())
    again = bn.load_map(map_folder)
    assert again.info == after.info
    assert len(require(again.landmarks)) == more
    assert bn.Localizer(again)(new[0].frame).converged


def test_the_same_photos_change_nothing(map_folder: Path) -> None:
    before = files(map_folder)
    same = bn.extend(map_folder, training_views()[:3], steps=STEPS, config=BAKE)
    assert len(same.info.cameras) == 7
    assert files(map_folder) == before


def test_a_photo_that_was_added_under_another_name_is_known(stored: Path) -> None:
    """Another folder's first photo has the name of the map's first one."""
    scene, new = bn.load_map(stored), training_views()[7]
    name = scene.info.cameras[0].name
    frame = replace(new.frame, name=name)
    located = localize_new(scene, [frame], [])
    assert [each.frame.name for each in located] == [f"{name}_2"]
    info = replace(scene.info, cameras=(*scene.info.cameras, *stored_cameras(located)))
    assert localize_new(replace(scene, info=info), [frame], []) == []


def test_another_scene_is_refused(map_folder: Path) -> None:
    before = files(map_folder)
    others = [replace(view(each.T_ref_camera, f"x{n}", 9)) for n, each in enumerate(training_views()[:1])]
    with refused(where=map_folder, found="localizes 0 of 1 photo", expected="photos of its scene"):
        bn.extend(map_folder, others, steps=STEPS, config=BAKE)
    assert files(map_folder) == before


def test_photos_found_too_imprecisely_are_not_called_another_scene(
    stored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solve = bn.Localizer.solve
    monkeypatch.setattr(bn.Localizer, "solve", lambda *given: replace(solve(*given), outcome=bn.Outcome.IMPRECISE))
    with refused(found="localizes 0 of 1 photo, and 1 more, but too imprecisely", expected="from as near"):
        localize_new(bn.load_map(stored), [training_views()[7].frame], [])


def test_a_cancelled_extension_leaves_the_map(map_folder: Path) -> None:
    before, steps = files(map_folder), []
    with pytest.raises(Cancelled):
        bn.extend(
            map_folder,
            training_views()[7:],
            steps=STEPS,
            config=BAKE,
            progress=lambda p: steps.append(p) if p.stage == "training" else None,
            cancel=lambda: len(steps) > 3,
        )
    assert files(map_folder) == before
    with job_context(cancel=lambda: True), pytest.raises(Cancelled, match="rendering"):
        bn.load_map(map_folder).render(training_views()[0])


def test_the_images_of_the_map_may_be_given(map_folder: Path) -> None:
    """In a map in metres as well, whose field keeps the unit of its training."""
    large = bn.load_map(map_folder).scaled(2.0)
    old = [
        replace(
            v,
            frame=replace(v.frame, depth=None),
            T_ref_camera=bn.SE3(v.T_ref_camera.rotation, 2 * v.T_ref_camera.translation),
        )
        for v in training_views()[:7]
    ]
    new = training_views()[7]
    new = replace(new, frame=replace(new.frame, depth=2 * require(new.frame.depth)))
    after = bn.extend(large, [new], old, steps=STEPS, config=BAKE)
    assert len(after.info.cameras) == 8
    assert after.folder is None
    truth = training_views()[7].T_ref_camera.translation
    assert float((after.info.cameras[7].pose.translation - 2 * truth).norm()) < 0.06
    with refused(where="map in memory", found="none of the images that the map was built from"):
        bn.extend(large, [new], [replace(old[0], frame=replace(old[0].frame, name="z"))])


def test_photos_that_cannot_be_read_are_left_out(
    map_folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene = bn.load_map(map_folder)
    known, photos = training_views()[0].frame, tmp_path / "photos"
    write_photo(photos / f"{known.name}.png", (known.rgb.numpy() * 255).round().astype("uint8"))
    (photos / "b.png").write_bytes((photos / f"{known.name}.png").read_bytes()[:500])
    with caplog.at_level("INFO", "bidnerf"):
        assert len(bn.extend(scene, photos).info.cameras) == 7
    assert "0 of 2 photos localized, 1 already in the map, 1 left out" in caplog.text
    (photos / f"{known.name}.png").unlink()
    with refused(found=f"{photos / 'b.png'}: not readable as an image"):
        bn.extend(scene, photos)


@pytest.mark.parametrize(
    ("photos", "found", "expected"),
    [
        ([], "no photos to add", "at least one"),
        ([3], "photos holds a int", "frames, views, or a path"),
        (Path("nowhere"), "nowhere: no such file", None),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_what_is_no_photo_is_refused(stored: Path, photos: object, found: str, expected: str | None) -> None:
    with refused(found=found, expected=expected):
        bn.extend(stored, photos)  # type: ignore[arg-type]


def test_the_command(bidnerf: Run, map_folder: Path, tmp_path: Path) -> None:
    write_transforms(
        tmp_path / "new",
        {"train": list(training_views()[7:9])},
    )
    _, out, err = bidnerf("extend", map_folder, tmp_path / "new", "--steps", STEPS).succeed()
    assert "2 photos added, 9 images in all" in out
    assert "2 of 2 photos localized" in err
    assert bidnerf("extend", map_folder, tmp_path / "new", "--steps", 0)[0] == 2
