"""The anchor of a map, a file that users write: it belongs to the map beside it, whenever writing stops."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from torch import nn

import tiny
from bidnerf import InputError, resume, train
from bidnerf_core.captures import CaptureReport, CoverageRecord
from bidnerf_core.fields import SceneBounds

# Inside: writes are counted and stopped at each
from bidnerf_core.maps import Anchor, Map, MapInfo, TrainOptions, load_info, load_map, store, write_parts
from bidnerf_core.progress import Progress
from bidnerf_core.training import TrainingState
from interruptions import FULL, Stopped, outcomes
from test_storage import names


@pytest.fixture(scope="module")
def trained() -> Map:
    return train(tiny.views(3), config=tiny.config(2), bake=False)


def save(folder: Path, trained: Map, step: int, anchor: Anchor | None = None) -> None:
    """Save the map as one of that number of steps."""
    state = TrainingState(step, cast(nn.Module, trained.field).state_dict(), {})
    write_parts(folder, replace(trained.info, step=step, anchor=anchor), state)


@pytest.mark.parametrize(
    ("new", "error"),
    [(Anchor(47.0, 19.0, 100.0, metres_per_unit=0.5), Stopped()), (None, Stopped()), (None, FULL)],
    ids=["moved", "dropped", "dropped, full"],
)
def test_a_save_that_stops_anywhere_leaves_a_map_with_its_own_anchor(
    new: Anchor | None, error: BaseException, tmp_path: Path, trained: Map
) -> None:
    """And whatever is saved next completes it."""
    places = (tmp_path / str(number) for number in itertools.count())
    old, folder = Anchor(47.0, 19.0, 100.0), tmp_path

    def attempt() -> None:
        nonlocal folder
        folder = next(places)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(store, "write_file", Path.write_bytes)  # not counted
            save(folder, trained, 5)
        tiny.write_anchor(folder, old)
        save(folder, trained, 6, new)

    for number, raised in enumerate(outcomes(attempt, error, ((Path, "unlink"),))):
        loaded = load_map(folder)
        expected = {5: old, 6: new}[loaded.info.step]
        assert loaded.anchor == expected
        assert raised is not None or loaded.info.step == 6
        if number % 2:
            write_parts(folder, loaded.info, capture=CaptureReport((), CoverageRecord()))
        else:
            expected = Anchor(1.0, 2.0, 3.0)
            tiny.write_anchor(folder, expected)
        assert load_map(folder).anchor == expected


def test_a_map_does_not_take_over_the_anchor_of_the_one_before(tmp_path: Path) -> None:
    train(tiny.views(3), out=tmp_path / "a", config=tiny.config(3), bake=False)
    tiny.write_anchor(tmp_path / "a", anchor := Anchor(47.0, 19.0, 100.0))
    load_map(tmp_path / "a").save(tmp_path / "b")
    assert load_map(tmp_path / "b").anchor == anchor
    again = TrainOptions(overwrite=True, checkpoint_seconds=0)
    train(tiny.views(3), out=tmp_path / "a", config=tiny.config(3), bake=False, options=again)
    assert names(tmp_path / "a") == {"map.json", load_info(tmp_path / "a").weights}
    load_map(tmp_path / "a").save(tmp_path / "b", overwrite=True)
    assert load_map(tmp_path / "b").anchor is None


def test_a_training_that_goes_on_keeps_the_anchor(tmp_path: Path) -> None:
    def stop(progress: Progress) -> None:
        if progress.stage == "training" and progress.done == 2:
            raise Stopped

    options = TrainOptions(checkpoint_seconds=0)
    with pytest.raises(Stopped):
        train(tiny.views(3), out=tmp_path, config=tiny.config(4), bake=False, options=options, progress=stop)
    tiny.write_anchor(tmp_path, anchor := Anchor(47.0, 19.0, 100.0))
    assert resume(tmp_path, tiny.views(3), bake=False).info.complete
    assert load_map(tmp_path).anchor == anchor


def test_damaged_anchors_are_refused(tmp_path: Path) -> None:
    bounds = SceneBounds((0, 0, 0), (1, 1, 1), 0, 1)
    write_parts(tmp_path, MapInfo("hashgrid", {}, bounds, 1, True), TrainingState(1, {}, {}))
    assert load_info(tmp_path).anchor is None
    good: dict[str, Any] = {"latitude": 47.0, "longitude": 19.0, "height": 100.0}
    (tmp_path / "anchor.json").write_text(json.dumps(good))
    assert load_info(tmp_path).anchor == Anchor(**good)
    for change, part in (
        ({"latitude": 91.0}, "latitude is 91"),
        ({"longitude": None}, "longitude"),
        ({"T_enu_world": [[1.0]]}, "4 rows"),
        ({"T_enu_world": [[2.0, 0.0, 0.0, 0.0], *[[0.0] * 4] * 3]}, "T_enu_world"),
        ({"metres_per_unit": 0.0}, "metres_per_unit is 0"),
        ({"position_sigma": -1.0}, "position_sigma is -1"),
        ({"lattitude": 1.0}, "lattitude"),
    ):
        (tmp_path / "anchor.json").write_text(json.dumps(good | change))
        with pytest.raises(InputError, match=r"anchor\.json: .*" + part):
            load_info(tmp_path)
