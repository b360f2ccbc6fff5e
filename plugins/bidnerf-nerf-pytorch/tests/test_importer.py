"""Checkpoints through ``bidnerf import``."""

from __future__ import annotations

import pytest

from bidnerf_core import ImportOptions, import_map
from bidnerf_core.errors import InputError
from bidnerf_core.maps import importer_of
from bidnerf_nerf_pytorch.importer import importer
from checkpoints import Writer


def test_a_checkpoint_is_recognised_and_imported(write: Writer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bidnerf_core.maps.viewpoints.PLACES", 4)
    assert importer_of(write())[0] == "nerf-pytorch"
    scene = import_map(write(), config={"near": 1.0, "background": "black"}, bake=False)
    assert scene.info.backend == "nerf-pytorch"
    assert (scene.bounds.near, scene.bounds.background) == (1.0, (0.0, 0.0, 0.0))
    assert scene.info.cameras


def test_other_files_are_not(write: Writer) -> None:
    assert not importer.recognises(write({"model": 1}, "other.ckpt"))
    assert not importer.recognises(write({"model": 1}, "other.txt"))
    assert not importer.recognises(write().parent / "none.ckpt")


def test_networks_stay_where_they_were_trained(write: Writer) -> None:
    with pytest.raises(InputError, match="cannot be moved or scaled"):
        import_map(write(), bake=False, options=ImportOptions(scale=2.0))
