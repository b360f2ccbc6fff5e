"""The anchor of a map, a file that users write: it belongs to the map beside it, whenever writing stops."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

import tiny
from bidnerf_core import resume, train
from bidnerf_core.captures import CaptureReport, CoverageRecord

# Inside: writes are counted and stopped at each, and an anchor is written as users write it
from bidnerf_core.maps import Anchor, Map, files, load_anchor, load_info, load_map, save_map
from bidnerf_core.maps.anchor import anchor_bytes, save_anchor
from bidnerf_core.maps.files import save_capture
from bidnerf_core.progress import Progress
from bidnerf_core.training import TrainingState
from drawn import poses, record, shares
from interruptions import FULL, Stopped, outcomes


@pytest.fixture(scope="module")
def trained() -> Map:
    return train(tiny.views(3), config=tiny.config(2), bake=False)


def save(folder: Path, trained: Map, step: int, **options: Any) -> None:
    """Save the map as one of that number of steps."""
    state = TrainingState(step, cast(nn.Module, trained.field).state_dict(), {})
    save_map(folder, replace(trained.info, step=step), state, **options)


def names(folder: Path) -> set[str]:
    return {file.name for file in folder.iterdir()}


@given(
    anchor=record(
        Anchor, latitude=st.floats(-89, 89), longitude=st.floats(-180, 180), metres_per_unit=st.floats(1e-3, 1e3),
        T_enu_world=poses().map(lambda T: tuple(map(tuple, T.matrix().tolist()))), position_sigma=shares,
        orientation_sigma=shares,
    )
)  # fmt: skip
def test_any_anchor_comes_back_as_it_was(anchor: Anchor, tmp_path: Path) -> None:
    save_anchor(tmp_path, anchor)
    assert load_anchor(tmp_path) == anchor


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
            patch.setattr(files, "write_file", Path.write_bytes)  # not counted
            save(folder, trained, 5)
            (folder / "anchor.json").write_bytes(anchor_bytes(old))
        save(folder, trained, 6, anchor=new)

    for number, raised in enumerate(outcomes(attempt, error, ((Path, "unlink"),))):
        loaded = load_map(folder)
        expected = {5: old, 6: new}[loaded.info.step]
        assert loaded.anchor == expected
        assert raised is not None or loaded.info.step == 6
        following = number % 3
        if following == 0:
            save(folder, trained, 7, anchor="kept")
        elif following == 1:
            save_capture(folder, loaded.info, CaptureReport((), CoverageRecord()))
        else:
            expected = Anchor(1.0, 2.0, 3.0)
            save_anchor(folder, expected)
        assert load_map(folder).anchor == expected
        assert load_anchor(folder) == expected or following == 2
        assert not any(name.startswith("anchor-") for name in names(folder))


def test_a_map_does_not_take_over_the_anchor_of_the_one_before(tmp_path: Path) -> None:
    trained = train(tiny.views(3), out=tmp_path / "a", config=tiny.config(3), bake=False)
    save_anchor(tmp_path / "a", anchor := Anchor(47.0, 19.0, 100.0))
    trained.save(tmp_path / "b")
    assert load_map(tmp_path / "b").anchor == anchor
    again = {"bake": False, "overwrite": True, "checkpoint_seconds": 0}
    train(tiny.views(3), out=tmp_path / "a", config=tiny.config(3), **again)  # type: ignore[arg-type]
    assert names(tmp_path / "a") == {"map.json", load_info(tmp_path / "a").weights}
    load_map(tmp_path / "a").save(tmp_path / "b", overwrite=True)
    assert load_map(tmp_path / "b").anchor is None


def test_a_training_that_goes_on_keeps_the_anchor(tmp_path: Path) -> None:
    def stop(progress: Progress) -> None:
        if progress.stage == "training" and progress.done == 2:
            raise Stopped

    options = {"bake": False, "progress": stop, "checkpoint_seconds": 0}
    with pytest.raises(Stopped):
        train(tiny.views(3), out=tmp_path, config=tiny.config(4), **options)  # type: ignore[arg-type]
    save_anchor(tmp_path, anchor := Anchor(47.0, 19.0, 100.0))
    assert resume(tmp_path, tiny.views(3), bake=False).info.complete
    assert load_map(tmp_path).anchor == anchor
