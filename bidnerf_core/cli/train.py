"""``bidnerf train``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from bidnerf_core.backend import load_backend
from bidnerf_core.captures import RefinementChoice
from bidnerf_core.cli.camera_options import (
    DatasetCamera,
    DatasetDepthUnit,
    MaskHides,
    Masks,
    RegisterDepth,
    depth_registration,
    mask_folder,
)
from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import (
    DEFAULT_BACKEND,
    Device,
    FeaturesName,
    Flag,
    Largest,
    option,
    parse,
    require,
    value_of,
    wrong_usage,
)
from bidnerf_core.cli.progress import Display, stopped_by_ctrl_c
from bidnerf_core.datasets import DatasetOptions, SparseChoice, open_dataset
from bidnerf_core.devices import working_device
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.io import Background, background_colour, from_plain
from bidnerf_core.mapping import USUAL_FEATURES
from bidnerf_core.maps import (
    CHECKPOINT_SECONDS,
    DESCRIPTION,
    Images,
    MapInfo,
    OtherSettings,
    TrainOptions,
    interrupted,
    load_info,
    longest_side,
)
from bidnerf_core.maps import resume as resume_training
from bidnerf_core.maps import train as train_map
from bidnerf_core.settings import to_flat
from bidnerf_core.structure import lacks_poses


def run(arguments: list[str]) -> None:
    """Parse with the options of the backend named in the arguments, and train."""
    named = value_of("--backend", arguments)
    resumed = None if named else _resumed_map(arguments)
    name = named or (resumed[1].backend if resumed else DEFAULT_BACKEND)
    default = load_backend(name, str(resumed[0]) if resumed else "").config_type()

    def train(
        data: Annotated[
            Path,
            tyro.conf.Positional,
            option("DATA", "folder of a dataset or of photos without poses, or a video"),
        ],
        out: Annotated[Path, option("MAP", "folder for the map")],
        backend: Annotated[str, option("NAME", "one of 'bidnerf backends'")] = DEFAULT_BACKEND,
        split: Annotated[str, option("NAME", "split of the dataset to train on; all: every image")] = "train",
        camera: DatasetCamera = None,
        register_depth: RegisterDepth = None,
        depth_unit: DatasetDepthUnit = None,
        masks: Masks = None,
        mask_hides: MaskHides = "black",
        largest: Largest = None,
        background: Annotated[
            str | None,
            option("COLOUR", "colour behind images with alpha: white or black", "as in the dataset"),
        ] = None,
        resume: Annotated[Flag, option(None, "continue the interrupted training in --out", "")] = False,
        overwrite: Annotated[Flag, option(None, "replace the map in --out", "")] = False,
        checkpoint_every: Annotated[
            float,
            option("SECONDS", "time between checkpoints: the most work lost if the program is killed"),
        ] = CHECKPOINT_SECONDS,
        depth_points: Annotated[
            Path | None,
            option("MODEL", "COLMAP sparse model whose points provide depth for images without any", ""),
        ] = None,
        refine_poses: Annotated[
            RefinementChoice,
            option(
                "WHEN",
                "refine the given poses with the keypoints that images share: always, never, or auto (if"
                " inconsistent)",
            ),
        ] = "auto",
        trust_poses: Annotated[
            Flag, option(None, "train even if the given poses contradict most pairs of photos", "")
        ] = False,
        landmark_features: FeaturesName = USUAL_FEATURES,
        device: Device = "cpu",
        no_bake: Annotated[
            Flag, option(None, "leave the surface and landmarks to 'bidnerf bake'", "")
        ] = False,
        model_points: SparseChoice = SparseChoice(),
        config: Any = None,
    ) -> None:
        """Build a map from a dataset, or from photos without poses.

        Poses that photos or video frames lack are found first, as by 'bidnerf poses', and kept in the folder
        MAP-poses. Ctrl-C stops after a step and saves the map; --resume continues from there, or from the
        last checkpoint if the program was killed, with the same result as an uninterrupted training. It also
        bakes a map that is trained but not baked.
        """
        require("--checkpoint-every", checkpoint_every, 0)
        if resume and overwrite:
            raise UsageError(
                "--resume continues a map, --overwrite starts a new one; expected only one of them"
            )
        if largest is not None:
            require("--largest", largest, 1)
        if background is not None:
            with wrong_usage():
                background_colour(background)
        check_folder(out, (data,), may_be_map=True)
        working_device(device)
        begun: Background | None = background
        photos = lacks_poses(data)
        if photos and (depth_unit is not None or register_depth is not None):
            raise UsageError(
                f"{data}: photos without poses have no depth; leave out --depth-unit and --register-depth"
            )
        if photos and masks is not None:
            raise UsageError(
                f"{data}: photos without poses; find them with 'bidnerf poses', then train with --masks"
            )
        if photos and not (out / DESCRIPTION).exists():
            resume = False  # it was interrupted during pose estimation, which resumes by itself
        if resume:
            info = interrupted(out, not no_bake)
            _check_unchanged(out, info, named, default, config)
            _check_refinement(out, info, refine_poses)
            if largest is not None and largest != longest_side(info):
                raise UsageError(
                    f"{out}: was started with images of {longest_side(info)} px, got --largest {largest}; leave"
                    " it out"
                )
            if landmark_features not in (USUAL_FEATURES, info.landmark_features):
                began = f"--landmark-features {info.landmark_features}"
                raise UsageError(f"{out}: was started with {began}, got {landmark_features}; leave it out")
            begun = info.bounds.background if background is None else background
        images: Images = data
        if not photos:
            registration, hidden = depth_registration(register_depth), mask_folder(masks, mask_hides)
            images = open_dataset(
                data, begun, camera=camera, register_depth=registration, depth_unit=depth_unit, masks=hidden
            )
        with stopped_by_ctrl_c() as cancel, Display() as progress:
            options = TrainOptions(
                DatasetOptions(
                    split=split,
                    largest=largest,
                    camera=camera if photos else None,
                    background=begun if photos else None,
                ),
                landmark_features,
                device,
                overwrite,
                refine_poses,
                trust_poses,
                depth_points,
                model_points,
                checkpoint_every,
            )
            same: dict[str, Any] = {
                "bake": not no_bake, "options": options, "progress": progress, "cancel": cancel,
            }  # fmt: skip
            if not resume:
                train_map(images, name, out, config, **same)
                return
            try:
                resume_training(out, images, **same)
            except OtherSettings as error:
                raise UsageError(error) from error

    parse("train", train, arguments, default)


def _resumed_map(arguments: list[str]) -> tuple[Path, MapInfo] | None:
    """Return the folder and description of the map to resume, if the arguments name one that can be read."""
    out = value_of("--out", arguments)
    if "--resume" not in arguments or out is None:
        return None
    try:
        return Path(out), load_info(Path(out))
    except InputError:  # reported later, if the arguments are otherwise valid
        return None


def _check_unchanged(out: Path, info: MapInfo, backend: str | None, default: Any, config: Any) -> None:
    """Raise ``UsageError`` for settings that differ from those of the interrupted training, since they would
    be ignored.
    """
    if backend not in (None, info.backend):
        raise UsageError(f"{out}: uses backend {info.backend!r}, cannot resume it with {backend!r}")
    began = from_plain(type(config), info.config, f"{out}: config")
    stored, given, usual = (to_flat(settings) for settings in (began, config, default))
    for key, value in given.items():
        if value not in (usual[key], stored[key]):
            raise UsageError(
                f"{out}: was started with {key} {stored[key]}, got {value}; --resume keeps settings,"
                " --overwrite starts again"
            )


def _check_refinement(out: Path, info: MapInfo, refinement: RefinementChoice) -> None:
    """Raise ``UsageError`` for a choice of pose refinement that differs from that of the interrupted training."""
    if info.pose_refinement is None:  # "never", or too few keypoints for any
        return
    refined = info.pose_refinement.refined or bool(info.pose_refinement.replaced)
    if refinement == ("never" if refined else "always"):
        has = "refined" if refined else "given"
        raise UsageError(
            f"{out}: was started with {has} poses, got --refine-poses {refinement}; --resume keeps the poses"
        )
