"""Makes the runs beside the tests, with nerfstudio itself and what it renders: needs nerfstudio 1.1.5, but no GPU.

    python -c "
    from bidnerf.scenes.closed_form_data import closed_form_data
    from bidnerf_core.datasets import write_transforms
    room = closed_form_data('demo:room')
    write_transforms('room', {split: room.views(split) for split in room.splits}, room.background)"
    python make_runs.py runs

The run of nerfacto is trained by nerfstudio's own trainer for some hundred steps on images of the closed-form room, which is in
the current folder. Models of vanilla-nerf and instant-ngp have a fixed size of megabytes: their weights are drawn (``drawn.py``)
and only the config and the values that nerfstudio computes with them are stored. The rays of instant-ngp are traced on a GPU
alone, so that its values are those at points.
"""

from __future__ import annotations

import copy
import json
import sys
from pathlib import Path
from typing import Any

import torch
import yaml
from nerfacc.grid import _query
from nerfstudio.cameras.rays import Frustums, RayBundle, RaySamples
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from safetensors.torch import save_file
from torch import Tensor

from drawn import drawn

DATA = Path("room/transforms_train.json")
POINTS = 200
CAMERA = 5  # of which an image is rendered
SPACING = 4  # pixels, of the image's pixels that are kept
NEVER = 10**9


def config_of(method: str, steps: int) -> Any:
    config = copy.deepcopy(all_methods[method])
    config.max_num_iterations, config.steps_per_save = steps, NEVER
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = NEVER
    config.mixed_precision, config.vis = False, "tensorboard"
    config.machine.device_type = "cpu"
    config.data, config.output_dir, config.experiment_name, config.timestamp = (
        DATA,
        Path("out"),
        "room",
        "run",
    )
    config.pipeline.datamanager = VanillaDataManagerConfig(
        data=DATA,
        dataparser=NerfstudioDataParserConfig(data=DATA, eval_mode="all"),
        train_num_rays_per_batch=512,
    )
    return config


def nerfacto(folder: Path, steps: int = 400) -> None:
    config = config_of("nerfacto", steps)
    model = config.pipeline.model
    model.implementation = "torch"
    model.num_levels, model.max_res, model.log2_hashmap_size = 4, 64, 9
    model.hidden_dim, model.hidden_dim_color, model.appearance_embed_dim = 16, 16, 4
    model.num_proposal_samples_per_ray, model.num_nerf_samples_per_ray = (32, 16), 12
    model.proposal_net_args_list = [
        {"hidden_dim": 8, "log2_hashmap_size": 8, "num_levels": 3, "max_res": 32, "use_linear": linear}
        for linear in (False, True)
    ]
    model.camera_optimizer.mode = "off"
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    made = Path("out/room/nerfacto/run")
    checkpoint = max(made.glob("nerfstudio_models/*.ckpt"))
    for file in (made / "config.yml", made / "dataparser_transforms.json", checkpoint):
        there = folder / "nerfacto" / file.relative_to(made)
        there.parent.mkdir(parents=True, exist_ok=True)
        there.write_bytes(file.read_bytes())
    trained = trainer.pipeline.model.eval()
    trained.proposal_sampler.set_anneal(1.0)  # as in a model that is loaded
    found = at_points(trained.field)
    for number, network in enumerate(trained.proposal_networks):
        found[f"proposal{number}"] = network.density_fn(found["points"])[:, 0]
    cameras = trainer.pipeline.datamanager.train_dataset.cameras
    trained.renderer_rgb.background_color = "black"  # "last_sample" depends on where a ray is sampled
    seen = trained.get_outputs_for_camera_ray_bundle(cameras.generate_rays(camera_indices=CAMERA))
    found |= {
        "rgb": seen["rgb"][::SPACING, ::SPACING],
        "opacity": seen["accumulation"][::SPACING, ::SPACING, 0],
    }
    frames = sorted(json.loads(DATA.read_text())["frames"], key=lambda frame: frame["file_path"])
    found["pose"] = torch.tensor(frames[CAMERA]["transform_matrix"])
    found["lens"] = torch.tensor([frames[CAMERA][key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")])
    write(folder / "nerfacto", found)


def at_points(field: Any) -> dict[str, Tensor]:
    """Return random points and directions in the coordinates of the training, and what the field has there."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn((POINTS, 3), generator=generator)
    directions = torch.nn.functional.normalize(torch.randn((POINTS, 3), generator=generator), dim=-1)
    none = torch.zeros(POINTS, 1)
    frustums = Frustums(points, directions, none, none, none + 1)
    values = {kind.value: value for kind, value in field(RaySamples(frustums, camera_indices=none.long())).items()}
    return {
        "points": points,
        "directions": directions,
        "density": values["density"][:, 0],
        "colours": values["rgb"],
    }


def with_drawn_weights(method: str, folder: Path, box: float, **changes: Any) -> tuple[Any, dict[str, Any]]:
    """Return a model with weights that are drawn, after writing its config and the shapes of its tensors."""
    config = config_of(method, 1)
    for name, value in changes.items():
        setattr(config.pipeline.model, name, value)
    (folder / method).mkdir(parents=True, exist_ok=True)
    (folder / method / "config.yml").write_text(yaml.dump(config))
    aabb = torch.tensor([[-box] * 3, [box] * 3])
    model = config.pipeline.model.setup(scene_box=SceneBox(aabb), num_train_data=3, metadata={}, device="cpu").eval()
    state = model.state_dict()
    kept = ("layers", "hash_table", "embedding", "net", "binaries")
    shapes = {
        name: tuple(value.shape)
        for name, value in state.items()
        if any(part in name for part in kept) and not name.startswith("sampler.")  # which has the grid a second time
    }
    weights = drawn(shapes)
    model.load_state_dict({name: weights.get(name, value) for name, value in state.items()})
    others = {n: v.tolist() for n, v in state.items() if n not in shapes and v.numel() < 7 and "lpips" not in n}
    (folder / method / "tensors.json").write_text(json.dumps({"drawn": shapes, "others": others}, indent=1))
    return model, weights


def vanilla(folder: Path) -> None:
    model, _ = with_drawn_weights("vanilla-nerf", folder, 1.0, num_coarse_samples=16, num_importance_samples=24)
    found = at_points(model.field_fine)
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn((64, 3), generator=generator), dim=-1)
    ones = torch.ones(64, 1)
    bundle = RayBundle(-4 * directions, directions, ones, ones.long() * 0, 2 * ones, 6 * ones)
    seen = model.get_outputs(bundle)
    found |= {"rays": directions, "rgb": seen["rgb_fine"], "rough": seen["rgb_coarse"]}
    found["opacity"] = seen["accumulation_fine"][:, 0]
    write(folder / "vanilla-nerf", found)


def instant_ngp(folder: Path) -> None:
    model, _ = with_drawn_weights(
        "instant-ngp", folder, 1.0, log2_hashmap_size=8, max_res=64, grid_resolution=8, grid_levels=2
    )
    found = at_points(model.field)
    grid = model.occupancy_grid
    held, within = _query(found["points"], grid.binaries, grid.aabbs[0])
    write(folder / "instant-ngp", found | {"held": held.bool() & within.bool()})


def write(folder: Path, values: dict[str, Tensor]) -> None:
    save_file(
        {name: value.detach().contiguous() for name, value in values.items()},
        folder / "reference.safetensors",
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    out = Path(sys.argv[1])
    nerfacto(out)
    with torch.no_grad():
        vanilla(out)
        instant_ngp(out)
