"""Anchors of maps, as users write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from bidnerf_core import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.maps import Anchor, MapInfo, load_info, write_parts
from bidnerf_core.training import TrainingState


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
        ({"position_sigma": -1.0}, "expected 0 or more"),
        ({"lattitude": 1.0}, "latitude"),
    ):
        (tmp_path / "anchor.json").write_text(json.dumps(good | change))
        with pytest.raises(InputError, match=r"anchor\.json: .*" + part):
            load_info(tmp_path)
