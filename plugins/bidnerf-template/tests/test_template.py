"""The contracts, which test all that is required of a backend and of a command. A small config keeps them fast."""

from __future__ import annotations

from pathlib import Path

import pytest

import bidnerf_template
from bidnerf.testing import SCENE_BOUNDS, BackendContract, CommandContract
from bidnerf_core.maps import Map, MapInfo
from bidnerf_core.settings import to_flat

CONFIG = bidnerf_template.TemplateConfig(resolution=16, samples=32, steps=40, rays_per_step=512)


class TestTemplate(BackendContract):
    backend = bidnerf_template.backend
    config = CONFIG


@pytest.mark.usefixtures("untrained")
class TestParameters(CommandContract):
    name = "template-parameters"
    arguments = ("map",)

    @pytest.fixture
    def untrained(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """A folder that holds a map whose field is untrained."""
        monkeypatch.chdir(tmp_path)
        field = bidnerf_template.backend.build(CONFIG, SCENE_BOUNDS)
        Map(MapInfo("template", to_flat(CONFIG), SCENE_BOUNDS, 40, complete=True), field).save("map")
