"""Runs become maps in the coordinates of their dataset; what is damaged or cannot be read is named."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, Similarity
from bidnerf_core.io import read_saved
from bidnerf_core.maps import UNMOVED, ImportedField, importer_of
from bidnerf_nerfstudio.importer import ImportSettings, importer
from bidnerf_nerfstudio.placement import Placement, after, inverse
from bidnerf_nerfstudio.run import read_run
from stored_runs import RunOf


def read(folder: Path, placement: Similarity = UNMOVED, **config: Any) -> ImportedField:
    return importer.read(folder, ImportSettings(**config), placement)


def refusal(folder: Path, **config: Any) -> str:
    with pytest.raises(InputError) as caught:
        read(folder, **config)
    message = str(caught.value)
    assert "\n" not in message
    return message


def checkpoint(folder: Path) -> Path:
    return next((folder / "nerfstudio_models").glob("*.ckpt"))


def changed(folder: Path, **tensors: Tensor | None) -> None:
    """Replace tensors of the model, or remove those given as None."""
    pipeline = dict(read_saved(checkpoint(folder), "a checkpoint")["pipeline"])
    for name, value in tensors.items():
        pipeline.pop(f"_model.{name}", None)
        if value is not None:
            pipeline[f"_model.{name}"] = value
    torch.save({"step": 9, "pipeline": pipeline}, checkpoint(folder))


def configured(folder: Path, old: str, new: str) -> None:
    file = folder / "config.yml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def points() -> Tensor:
    return torch.randn((20, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def trained_of(found: ImportedField) -> Similarity:
    return Placement.of(found.config.placement, found.bounds).similarity


def test_a_run_is_recognised_by_its_config(run_of: RunOf, tmp_path: Path) -> None:
    folder = run_of("nerfacto")
    assert importer_of(folder)[0] == importer_of(folder / "config.yml")[0] == "nerfstudio"
    (tmp_path / "config.yml").write_text("pipeline: 3\n")
    for other in (tmp_path, tmp_path / "config.yml", tmp_path / "none", checkpoint(folder)):
        assert not importer.recognises(other)


def test_what_was_found_is_told(run_of: RunOf) -> None:
    found = read(run_of("nerfacto"))
    assert (found.backend, found.steps, found.bounds.contracted) == ("nerfstudio-nerfacto", 400, True)
    told = " ".join(found.found)
    assert "NerfactoModel of nerfstudio, 400 steps (step-000000399.ckpt)" in told
    assert "room/transforms_train.json is no longer there" in told
    assert "`photos`" in told
    assert found.photos is None


def test_poses_are_those_of_the_dataset(run_of: RunOf) -> None:
    """The coordinates of the training are ``scale * (transform @ p)``, by the documentation of nerfstudio."""
    folder = run_of("nerfacto")
    said = json.loads((folder / "dataparser_transforms.json").read_text())
    rows = torch.tensor(said["transform"], dtype=torch.float64)
    expected = said["scale"] * (points() @ rows[:, :3].mT + rows[:, 3])
    found = read(folder)
    assert torch.allclose(trained_of(found).apply(points()), expected, atol=1e-6)
    assert found.bounds.near == pytest.approx(0.05 / said["scale"])


def test_what_was_applied_to_the_dataset_before_is_not_undone(run_of: RunOf, tmp_path: Path) -> None:
    """nerfstudio's transform begins before ``applied_transform``, but the poses in the dataset's file have it already."""
    folder, data = run_of("nerfacto"), tmp_path / "data"
    data.mkdir()
    turned = torch.tensor([[0.0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 2]], dtype=torch.float64)
    before = trained_of(read(folder)).apply(points())
    meta = {"applied_transform": turned.tolist(), "applied_scale": 2.0}
    (data / "transforms.json").write_text(json.dumps(meta))
    found = read(folder, data=str(data))
    assert "applied_transform is taken into account" in " ".join(found.found)
    assert found.photos == data
    stored = 2.0 * (points() @ turned[:, :3].mT + turned[:, 3])
    assert torch.allclose(trained_of(found).apply(stored), before, atol=1e-6)


def test_a_map_in_another_world(run_of: RunOf) -> None:
    folder = run_of("nerfacto")
    T = SE3.exp(torch.tensor([1.0, -2, 0.5, 0.4, 1.1, -0.7], dtype=torch.float64))
    moved = Similarity(3.0, T)
    here, there = trained_of(read(folder)), trained_of(read(folder, moved))
    assert torch.allclose(there.apply(moved.apply(points())), here.apply(points()), atol=1e-6)
    assert torch.allclose(after(moved, inverse(moved)).apply(points()), points())


def test_a_run_without_its_transform(run_of: RunOf) -> None:
    folder = run_of("nerfacto")
    (folder / "dataparser_transforms.json").unlink()
    found = read(folder)
    assert "poses will be in training coordinates" in " ".join(found.found)
    assert torch.allclose(trained_of(found).apply(points()), points())
    for text, said in (
        ('{"transform": [1], "scale": 1}', "is not 3x4 or 4x4"),
        ('{"transform": [[2,0,0,0],[0,1,0,0],[0,0,1,0]], "scale": 1}', "expected a rigid transform"),
        ('{"transform": [[1,0,0,0],[0,1,0,0],[0,0,1,0]], "scale": 0}', "above 0"),
        ('{"transform": [[1,0,0,0],[0,1,0,0],[0,0,-1,0]], "scale": 1}', "expected a rigid transform"),
        ("{", "not JSON"),
    ):
        (folder / "dataparser_transforms.json").write_text(text)
        assert said in refusal(folder)


def test_no_checkpoint_and_the_latest_of_several(run_of: RunOf) -> None:
    folder = run_of("nerfacto")
    latest = checkpoint(folder)
    latest.rename(latest.with_name("step-000012000.ckpt"))
    (latest.parent / "step-000009000.ckpt").write_bytes(b"")
    assert read_run(folder).checkpoint.name == "step-000012000.ckpt"
    for file in latest.parent.iterdir():
        file.unlink()
    assert "no step-*.ckpt" in refusal(folder)


def test_damaged_checkpoints(run_of: RunOf) -> None:
    folder = run_of("nerfacto")
    whole = checkpoint(folder).read_bytes()
    for content in (whole[:-1000], b"", b"text"):
        checkpoint(folder).write_bytes(content)
        assert "not written by torch.save, or damaged" in refusal(folder)
    torch.save([1], checkpoint(folder))
    assert "no 'pipeline'" in refusal(folder)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("field.mlp_head.layers.0.weight", None, "no 'field.mlp_head.layers.0.weight'"),
        ("field.mlp_head.layers.1.weight", torch.zeros(16, 15), "expected (16, 16)"),
        ("field.mlp_head.layers.1.bias", torch.full((16,), torch.nan), "finite numbers"),
        ("field.mlp_base.model.0.hash_table", torch.zeros(100, 2), "has 100 rows, expected 4 tables"),
        ("field.mlp_base.model.0.hash_table", torch.zeros(1).expand(2**30, 2), "unpacks to"),
        ("field.log2_hashmap_size", torch.tensor(60), "expected 4 tables of 2 to the power of 60"),
        ("field.aabb", torch.zeros(6), "expected (2, 3)"),
        ("field.aabb", torch.zeros(2, 3), "is empty"),
        ("proposal_networks.1.linear.weight", None, "no 'proposal_networks.1.mlp_base.1.layers.0.weight'"),
    ],
)
def test_tensors_that_do_not_fit(run_of: RunOf, name: str, value: Tensor | None, said: str) -> None:
    folder = run_of("nerfacto")
    changed(folder, **{name: value})
    assert said in refusal(folder)


def test_weights_of_tiny_cuda_nn_are_named(run_of: RunOf) -> None:
    folder = run_of("nerfacto")
    changed(folder, **{"field.mlp_base.model.params": torch.zeros(100, dtype=torch.half)})
    assert "--pipeline.model.implementation torch" in refusal(folder)


def test_runs_of_other_methods_are_named(run_of: RunOf) -> None:
    folder = run_of("nerfacto")
    configured(folder, "nerfacto.NerfactoModel", "tensorf.TensoRFModel")
    assert "a run of TensoRFModel" in refusal(folder)
    folder = run_of("vanilla-nerf")  # the tensors of another method than the config names
    configured(folder, "vanilla_nerf.NeRFModel", "nerfacto.NerfactoModel")
    assert "expected a checkpoint of the model that the config names" in refusal(folder)


class Code:
    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (self.command,)


def test_code_is_not_run(run_of: RunOf, tmp_path: Path) -> None:
    folder, mark = run_of("nerfacto"), tmp_path / "mark"
    config = (folder / "config.yml").read_text()
    hostile = yaml.dump({"project": Code(f"touch {mark}")}) + config.partition("\n")[2]
    (folder / "config.yml").write_text(hostile)
    assert read(folder).backend == "nerfstudio-nerfacto"  # the command is a text among the settings
    torch.save({"pipeline": {}, "step": Code(f"touch {mark}")}, checkpoint(folder))
    assert "would run code" in refusal(folder)
    assert not mark.exists()


def test_damaged_configs(run_of: RunOf) -> None:
    folder = run_of("nerfacto")
    for content, said in (
        (b"a: [", "not readable"),
        (b"- 1", "no pipeline"),
        (b"pipeline: {model: 3}", "no datamanager"),
        (b"&a [*a]", "no pipeline"),
        (b"\xff\x00", "not readable"),
        (b"x" * (5 * 2**20), "bytes"),
    ):
        (folder / "config.yml").write_bytes(content)
        assert said in refusal(folder)
    (folder / "config.yml").unlink()
    assert "no config.yml" in refusal(folder)


def test_a_dataset_that_was_moved(run_of: RunOf, tmp_path: Path) -> None:
    assert "`data`" in refusal(run_of("nerfacto"), data=str(tmp_path / "none"))
    with pytest.raises(InputError, match="background"):
        ImportSettings(background="red")  # type: ignore[arg-type]
    assert read(tmp_path / "nerfacto", background="white").bounds.background == (1.0, 1.0, 1.0)


def test_splatfacto_is_read_by_the_plugin_for_gaussians(run_of: RunOf) -> None:
    pytest.importorskip("bidnerf_gaussians")
    folder = run_of("nerfacto")
    configured(folder, "nerfacto.NerfactoModel", "splatfacto.SplatfactoModel")
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "features_dc": 3}
    parts = {name: torch.randn((200, width), generator=generator) for name, width in shapes.items()}
    pipeline = {f"_model.gauss_params.{name}": value for name, value in parts.items()}
    torch.save({"step": 9, "pipeline": pipeline}, checkpoint(folder))
    found = read(folder)
    run = read_run(folder)
    to_training, _ = run.trained_from_data(None)
    assert found.backend == "gaussians"
    assert torch.allclose(
        to_training.apply(found.tensors["means"].double()).float().sort(0).values,
        parts["means"].sort(0).values,
        atol=1e-4,
    )
