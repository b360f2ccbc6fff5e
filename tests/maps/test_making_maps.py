"""Maps made from Python: in memory and in folders, in threads, cancelled, resumed, described, rendered and saved."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import make_dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

import bidnerf as bn
import tiny
from bidnerf.testing import training_views, unseen
from bidnerf_core.backend import FieldValues, Stratified, load_backend, quick_config
from bidnerf_core.geometry import perturb
from bidnerf_core.io import FileInUse, to_plain
from bidnerf_core.localization import settings_of
from bidnerf_core.mapping import BakeConfig
from bidnerf_core.maps import load_info, rendering_scores
from bidnerf_core.progress import Progress
from bidnerf_core.registry import PluginError
from bidnerf_hashgrid import backend as hashgrid
from optional import require
from refusals import refused
from trainings import assert_same_tensors, stopping_at

BAKE = BakeConfig(cells=5000)
DESCENT = settings_of("bid", {"rays": 64, "max_steps": 3})


IMAGES = bn.DatasetOptions(background=tiny.BACKGROUND)
OPTIONS = bn.TrainOptions(images=IMAGES)


def trained(out: Path | None = None, **given: Any) -> bn.Map:
    usual = {"config": tiny.config(), "bake": False, "options": OPTIONS}
    return bn.train(tiny.views(), out=out, **(usual | given))


def answer(scene: bn.Map, method: str = "bid") -> bn.Localization:
    (view,) = tiny.views(1, seed=1)
    start = perturb(view.T_ref_camera, 0.1, 5.0, seed=0)
    return bn.Localizer(scene, method, DESCENT if method == "bid" else None)(view.frame, start)


def assert_same_field(one: bn.Map, other: bn.Map) -> None:
    assert isinstance(one.field, nn.Module)
    assert isinstance(other.field, nn.Module)
    assert_same_tensors(one.field.state_dict(), other.field.state_dict())


@pytest.fixture(scope="module")
def scene() -> bn.Map:
    """A map in memory, trained and baked."""
    return trained(bake=BAKE)


@pytest.fixture(scope="module")
def whole() -> bn.Map:
    """A map in memory, trained without an interruption."""
    return trained()


def test_the_first_images_are_trained_on(tmp_path: Path) -> None:
    data = tiny.write_dataset(tmp_path / "data")
    for source, options in ((tiny.views(), OPTIONS), (data, bn.TrainOptions())):
        scene = bn.train(source, config=tiny.config(1), bake=False, options=replace(options, first=3))
        assert len(scene.info.cameras) == 3


def test_a_map_in_memory_answers_as_the_one_that_is_saved_and_loaded(scene: bn.Map, tmp_path: Path) -> None:
    assert scene.folder is None
    assert scene.surface is not None
    saved = scene.save(tmp_path / "map")
    loaded = bn.load_map(tmp_path / "map")
    assert_same_field(scene, loaded)
    for method in ("bid", "auto"):
        expected = answer(scene, method).T_world_camera.matrix()
        assert torch.equal(answer(loaded, method).T_world_camera.matrix(), expected)
    assert loaded.info == saved.info
    assert loaded.capture == scene.capture
    assert to_plain(loaded.bounds) == to_plain(scene.bounds)
    with refused(where=tmp_path / "map", found="exists already"):
        scene.save(tmp_path / "map")
    assert bn.load_map(scene.save(tmp_path / "map", overwrite=True).folder or "").surface is not None


def test_a_folder_a_path_a_dataset_and_views_give_the_same_map(tmp_path: Path) -> None:
    data = bn.open_dataset(tiny.write_dataset(tmp_path / "data"))
    options: dict[str, Any] = {"config": tiny.config(), "bake": False}
    stored = bn.train(data, out=tmp_path / "map", **options)
    assert stored.folder == tmp_path / "map"
    assert stored.info == load_info(tmp_path / "map")
    assert stored.info.data == "data"
    over = bn.TrainOptions(images=bn.DatasetOptions(background=data.background))
    views = bn.train(data.views("train"), options=over, **options)
    for other in (bn.train(tmp_path / "data", **options), views, bn.load_map(tmp_path / "map")):
        assert_same_field(stored, other)


def test_an_incomplete_map_is_saved_with_what_resuming_needs(whole: bn.Map, tmp_path: Path) -> None:
    with pytest.raises(bn.Cancelled):
        trained(tmp_path / "map", **stopping_at("training", 5))
    half = bn.load_map(tmp_path / "map").save(tmp_path / "copy")
    assert not half.info.complete
    assert_same_field(bn.resume(tmp_path / "copy", tiny.views(), bake=False), whole)


def test_cancelled_and_resumed_equals_uninterrupted(whole: bn.Map, tmp_path: Path) -> None:
    with pytest.raises(bn.Cancelled, match=r"saved after step 5; `resume`"):
        trained(tmp_path / "half", **stopping_at("training", 5))
    info = load_info(tmp_path / "half")
    assert (info.step, info.complete) == (5, False)
    resumed = bn.resume(tmp_path / "half", tiny.views(), bake=False)
    assert resumed.info.complete
    assert_same_field(resumed, whole)
    with refused(where=tmp_path / "half", found="complete (12 steps), nothing to resume"):
        bn.resume(tmp_path / "half", tiny.views(), bake=False)
    with pytest.raises(bn.Cancelled, match=r"has its landmarks, field and surface so far; `resume` continues"):
        bn.resume(
            tmp_path / "half",
            tiny.views(),
            bake=BAKE,
            cancel=lambda: load_info(tmp_path / "half").surface is not None,
        )  # during the survey, which is what is left to do
    surface = load_info(tmp_path / "half").surface
    surveyed = bn.resume(tmp_path / "half", tiny.views(), bake=BAKE)
    assert surveyed.capture is not None
    assert surveyed.info.surface == surface
    with refused(where=tmp_path / "half", found="complete (12 steps) and baked, nothing to resume"):
        bn.resume(tmp_path / "half", tiny.views())


@pytest.mark.parametrize(("stage", "damaged"), [("training", False), ("training", True), ("baking", False)])
def test_what_was_finished_is_kept_when_a_stage_is_cancelled_and_finish_ends_it(
    stage: str, damaged: bool, tmp_path: Path
) -> None:
    out, views = tmp_path / "map", [replace(v, frame=v.frame.replace(depth=None)) for v in training_views()]
    with pytest.raises(bn.Cancelled) as stopped:
        bn.train(views, out=out, config=tiny.config(), bake=BAKE, **stopping_at(stage))
    half = bn.load_map(out)
    if stage == "baking":
        assert "the map has its landmarks and field so far" in str(stopped.value)
    else:
        assert 0 < half.info.step < tiny.STEPS
        assert bn.Localizer(half, warm_up=False)(unseen().frame).converged
    if damaged:
        (out / require(half.info.training)).write_bytes(b"damaged")
        with refused(where=out / require(half.info.training)):
            bn.resume(out, views, bake=BAKE)
    progress = list[Progress]()
    done = bn.resume(out, views, bake=BAKE, finish=True, progress=progress.append)
    matched = [now for now in progress if now.stage == "landmarks" and now.total > len(views)]
    assert (len(matched) > 0) == (stage == "baking" or damaged)  # the matches are kept until the field is complete
    assert (done.info.complete, done.info.step) == (True, half.info.step)
    assert torch.equal(require(done.landmarks).positions, require(half.landmarks).positions)
    with refused(found="nothing to resume"):
        bn.resume(out, views)


def test_matches_are_kept_when_the_poses_are_not_refined_yet(tmp_path: Path) -> None:
    views, progress = [replace(v, frame=v.frame.replace(depth=None)) for v in training_views()], list[Progress]()
    stop = stopping_at("finding the bounds of the scene")
    with pytest.raises(
        bn.Cancelled, match=r"matches of its keypoints are kept, and the same command goes on from there"
    ):
        bn.train(views, out=tmp_path / "map", config=tiny.config(2), bake=BAKE, **stop)
    scene = bn.train(views, out=tmp_path / "map", config=tiny.config(2), bake=BAKE, progress=progress.append)
    assert [now for now in progress if now.stage == "landmarks" and now.total > len(views)] == []
    at_once = bn.train(views, config=tiny.config(2), bake=BAKE)
    assert torch.equal(require(scene.landmarks).positions, require(at_once.landmarks).positions)
    assert len(list((tmp_path / "map").glob("training-*"))) == 0


def test_quick_training_takes_the_backends_quick_settings(tmp_path: Path) -> None:
    with pytest.raises(bn.Cancelled):
        trained(tmp_path / "map", config="quick", **stopping_at("training"))
    assert load_info(tmp_path / "map").config["steps"] == quick_config(load_backend("hashgrid")).steps


def test_cancelling_before_training_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(bn.Cancelled):
        trained(tmp_path / "map", cancel=lambda: True)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(bn.Cancelled, match="nothing is stored"):
        trained(**stopping_at("training", 3))


class Failed(Exception):
    pass


def test_an_error_of_a_callback_ends_the_training_and_leaves_the_checkpoint(whole: bn.Map, tmp_path: Path) -> None:
    def fail(now: Progress) -> None:
        if now.stage == "training" and now.done == 7:
            raise Failed("the caller's own")

    with pytest.raises(Failed, match="the caller's own"):
        trained(tmp_path / "map", progress=fail, options=replace(OPTIONS, checkpoint_seconds=0))
    assert load_info(tmp_path / "map").step == 6
    assert_same_field(bn.resume(tmp_path / "map", tiny.views(), bake=False), whole)


def test_progress_counts_and_remarks_are_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    caplog.set_level(logging.INFO, "bidnerf")
    seen = list[Progress]()
    trained(tmp_path / "map", bake=BAKE, progress=seen.append)
    training = [now for now in seen if now.stage == "training"]
    assert [now.done for now in training] == list(range(1, tiny.STEPS + 1))
    assert str(training[-1]).startswith(f"training: {tiny.STEPS}/{tiny.STEPS} steps, loss ")
    assert "surface of" in caplog.text
    assert capfd.readouterr() == ("", "")


def test_a_thread_trains_while_another_localizes(scene: bn.Map, whole: bn.Map) -> None:
    expected = answer(scene)
    with ThreadPoolExecutor(2) as pool:
        training = pool.submit(trained, config=tiny.config(30))
        found = [pool.submit(answer, scene).result() for _ in range(3)]
        again = pool.submit(trained)
        assert training.result().info.step == 30
        assert_same_field(again.result(), whole)
    for one in found:
        assert torch.equal(one.T_world_camera.matrix(), expected.T_world_camera.matrix())


def test_of_two_threads_that_train_into_one_folder_the_second_is_refused(tmp_path: Path) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def wait(now: Progress) -> None:
        begun.set()
        assert go_on.wait(120)

    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(trained, tmp_path / "map", progress=wait)
        assert begun.wait(120)
        for second in (trained, lambda out, **_: bn.resume(out, tiny.views())):
            with pytest.raises(bn.InputError):
                second(tmp_path / "map")
        with refused(where=tmp_path / "map", found="another bidnerf process", error=FileInUse):
            trained(tmp_path / "map", options=replace(OPTIONS, overwrite=True))
        go_on.set()
        assert first.result().info.complete
    assert load_info(tmp_path / "map").complete


def test_baking_stores_what_it_made_where_the_map_is(scene: bn.Map, tmp_path: Path) -> None:
    bare = bn.train(tiny.views(), out=tmp_path / "map", config=tiny.config(), bake=False)
    baked = bare.bake(tiny.views(), config=BAKE)
    assert baked.surface is not None
    assert load_info(tmp_path / "map") == baked.info
    again = bn.load_map(tmp_path / "map").bake(tiny.views(), config=BAKE)
    assert again.info.surface != baked.info.surface
    with pytest.raises(bn.Cancelled):
        baked.bake(tiny.views(), config=BAKE, cancel=lambda: True)
    with refused(found="rendered_landmarks uses no photos", expected="only one of them"):
        baked.bake(tiny.views(), rendered_landmarks=True)
    assert load_info(tmp_path / "map") == again.info


def test_parts_that_were_not_read_are_saved(tmp_path: Path) -> None:
    baked = trained(tmp_path / "map", bake=BAKE)
    bare = bn.load_map(tmp_path / "map", baked=False)
    assert bare.surface is None
    for folder in (tmp_path / "copy", tmp_path / "map"):
        bare.save(folder, overwrite=True)
        found = bn.load_map(folder)
        assert len(require(found.surface).surfels) == len(require(baked.surface).surfels)


def test_a_description_is_for_people_and_for_json(scene: bn.Map) -> None:
    summary = scene.describe()
    assert "in memory, written by bidnerf" in str(summary)
    assert f"{tiny.STEPS} steps of backend hashgrid" in str(summary)
    facts = summary.plain()
    assert (facts["map"], facts["bytes"], facts["cameras"]) == ("", None, 6)
    assert facts["surfels"] == len(require(scene.surface).surfels) > 0


@pytest.mark.usefixtures("unchecked")
def test_a_rendering_is_scored_against_the_photo(scene: bn.Map) -> None:
    (view,) = tiny.views(1, seed=1)
    image = scene.render(view)
    scores = rendering_scores(image, view.frame)
    error = (image.rgb - view.frame.rgb).square().mean()
    assert scores.psnr == pytest.approx(float(-10 * error.log10()), abs=1e-3)
    depth = require(view.frame.depth)
    assert len(scores.depth_errors) == int((depth > 0).sum())
    perfect = rendering_scores(type(image)(view.frame.rgb, depth, image.opacity), view.frame)
    assert perfect.depth_error == 0
    assert not torch.equal(scene.render(view, level=0).rgb, image.rgb)
    with refused(where="map in memory", found="`level` is 2", expected="0 to 1"):
        scene.render(view, level=2)
    with refused(where="map in memory", found="view is a Frame", expected="a View"):
        scene.render(view.frame)  # type: ignore[arg-type]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("options", "where", "found", "expected"),
    [
        ({"data": []}, None, "data holds no views", None),
        ({"data": 3}, None, "data is or holds a int", "a dataset, a path, or views"),
        ({"data": [None]}, None, "data is or holds a NoneType", "a dataset, a path, or views"),
        ({"data": "/nowhere"}, "/nowhere", "no such file or folder", None),
        ({"backend": "hashgird"}, None, "no backend 'hashgird'", None),
        ({"config": {"stepps": 3}}, None, "no field 'stepps', did you mean 'steps'?", None),
        ({"config": 7}, None, "config is a int", "a HashGridConfig or a dict"),
        ({"options": bn.TrainOptions(device="tpu:9")}, None, "device 'tpu:9' does not work here", "cpu"),
        ({"bake": "yes"}, None, "bake is 'yes'", "True, False or a BakeConfig"),
        ({"progress": 3}, None, "progress is a int", "a function"),
        (
            {"cancel": threading.Event()},
            None,
            "cancel is a Event",
            "a function, such as the is_set of an event",
        ),
    ],
)
def test_wrong_arguments_are_refused_before_any_work(
    options: dict[str, Any], where: str | None, found: str, expected: str | None
) -> None:
    with refused(where=where, found=found, expected=expected):
        bn.train(**({"data": tiny.views(1), "config": tiny.config(1), "bake": False} | options))


def test_wrong_options_are_refused() -> None:
    for options, found in (
        ({"checkpoint_seconds": -1.0}, "checkpoint_seconds is -1.0"),
        ({"refine_poses": "maybe"}, "refine_poses is 'maybe'"),
        ({"features": "sfit"}, "no detector 'sfit'"),
    ):
        with refused(found=found):
            bn.TrainOptions(**options)  # type: ignore[arg-type]


class Column(nn.Module):
    """A field whose density has an axis too many."""

    sampler = Stratified(4)

    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        return FieldValues(positions[..., :1], positions)


@pytest.mark.parametrize(
    ("members", "found"),
    [
        ({"build": lambda config, bounds: nn.Linear(3, 4)}, "backend 'mine' built a Linear"),
        ({"build": lambda config, bounds: Column()}, "of shapes (2, 1) and (2, 3) at 2 points"),
        ({"config_type": make_dataclass("Endless", [("size", int, 3)], frozen=True)}, "Endless has no field steps"),
    ],
)
def test_a_backend_that_cannot_be_trained_is_refused_before_images_are_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, members: dict[str, Any], found: str
) -> None:
    kind = SimpleNamespace(
        **{name: getattr(hashgrid, name) for name in ("summary", "config_type", "build", "train")} | members
    )
    monkeypatch.setattr("bidnerf_core.registry.registered", {("backends", "mine"): kind})
    with refused(found=found):
        bn.train(tmp_path / "no such images", "mine", out=tmp_path / "map", bake=False)
    assert not (tmp_path / "map").exists()


@pytest.mark.usefixtures("unchecked")
def test_a_broken_detector_is_reported_before_the_field_is_trained(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("bidnerf_core.registry.registered", {("features", "blind"): lambda rgb: None})
    with refused(where="detector", found="returned a NoneType", expected="Keypoints", error=PluginError):
        options = bn.TrainOptions(images=IMAGES, features="blind", refine_poses="never")
        trained(tmp_path / "map", options=options, bake=BAKE)
    info = load_info(tmp_path / "map")
    assert (info.step, info.complete) == (0, False)
