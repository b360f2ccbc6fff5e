"""The map that tests of the viewer share."""

from __future__ import annotations

import pytest

import viewed
from bidnerf import Map, load_map
from once import made_once


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Map:
    """The map of the room, in a folder: its field is hardly trained, its surface and landmarks are exact."""
    return load_map(made_once(tmp_path_factory, "room", viewed.make_room) / "map")
