"""``bidnerf train``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from bidnerf_core.cli.folders import check_folder
from bidnerf_core.cli.options import DEFAULT_BACKEND, Device, FeaturesName, PointChoice, require, wrong_usage
from bidnerf_core.cli.parser import Flag, Option, Settings, parse
from bidnerf_core.cli.progress import working
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError

if TYPE_CHECKING:
    from bidnerf_core.maps import MapInfo

USUAL_FEATURES = "sift"


def _backend_settings(values: Mapping[str, Any], words: Sequence[str]) -> Any:
    """Return the default settings of the backend: the one named, or that of the map to resume."""
    from bidnerf_core.backend import load_backend, quick_config

    name, out = values["backend"], values["out"]
    resumed = _resumed(out) if (values["resume"] or values["finish"]) and name is None else None
    if resumed is not None and resumed.backend:
        return load_backend(resumed.backend, str(out)).config_type()
    backend = load_backend(name or DEFAULT_BACKEND)
    return quick_config(backend) if values["quick"] else backend.config_type()


def _resumed(out: Any) -> MapInfo | None:
    """Return the description of the map to resume, None if there is none that can be read, which is reported later."""
    from bidnerf_core.maps import load_info

    try:
        return load_info(out) if isinstance(out, Path) else None
    except InputError:
        return None


@dataclass(frozen=True)
class Train:
    """Build a map from a dataset, or from photos without poses.

    Poses that photos or video frames lack are found first, as by 'bidnerf poses', and kept in the folder MAP-poses. The landmarks
    come next, since they localize photos on their own, then the field and the surface. Ctrl-C stops after a step and saves
    the map; --resume continues from there, or from the last checkpoint if the program was killed, with the same result as an
    uninterrupted training, and --finish ends it as it stands. All of it takes 5 to 10 minutes on two cores for 85 to 436 images with
    poses, and 2 to 4 minutes of CPU time with --quick. If --out holds a map of landmarks alone, as 'bidnerf import' makes
    of a COLMAP model, it gets a field and a surface.
    """

    data: Annotated[
        Path, Option("DATA", "folder of a dataset or of photos without poses, or a video", positional=True)
    ]
    out: Annotated[Path, Option("MAP", "folder for the map")]
    backend: Annotated[str | None, Option("NAME", "one of 'bidnerf backends'", DEFAULT_BACKEND)] = None
    resume: Annotated[Flag, Option(None, "continue the interrupted training in --out")] = False
    finish: Annotated[
        Flag, Option(None, "end the interrupted training in --out now, with the steps done so far")
    ] = False
    quick: Annotated[Flag, Option(None, "train a short time: settings of the backend for a first map")] = (
        False
    )
    overwrite: Annotated[Flag, Option(None, "replace the map in --out")] = False
    device: Device = "cpu"
    no_bake: Annotated[Flag, Option(None, "leave the surface and landmarks to 'bidnerf bake'")] = False
    refine_poses: Annotated[
        Literal["auto", "always", "never"],
        Option(
            "WHEN",
            "refine the given poses with the keypoints that images share: always, never, or auto (if inconsistent)",
        ),
    ] = "auto"
    trust_poses: Annotated[
        Flag, Option(None, "train even if the given poses contradict most pairs of photos")
    ] = False
    landmark_features: FeaturesName = USUAL_FEATURES
    checkpoint_every: Annotated[
        float, Option("SECONDS", "time between checkpoints: the most work lost if the program is killed")
    ] = 60.0
    depth_points: Annotated[
        Path | None,
        Option("MODEL", "COLMAP sparse model whose points provide depth for images without any"),
    ] = None
    images: DatasetOptions = DatasetOptions()
    model_points: PointChoice = None
    """which points of a COLMAP model are used"""
    config: Annotated[Any, Settings(_backend_settings)] = None
    """size and training of the field: settings of the backend, such as --steps"""

    def __post_init__(self) -> None:
        require("--checkpoint-every", self.checkpoint_every, 0)
        continuing = "--resume" if self.resume else "--finish"
        if (self.resume or self.finish) and (self.overwrite or self.quick):
            other = "--overwrite" if self.overwrite else "--quick"
            raise UsageError(
                f"{continuing} continues a map, {other} starts a new one; expected only one of them"
            )
        if self.finish and self.no_bake:
            raise UsageError("--finish bakes the map, --no-bake does not; expected only one of them")
        if self.images.largest is not None:
            require("--largest", self.images.largest, 1)

    def run(self) -> None:
        from bidnerf_core.devices import working_device
        from bidnerf_core.io import background_colour
        from bidnerf_core.maps import DESCRIPTION, OtherSettings, TrainOptions, resume, train
        from bidnerf_core.structure import lacks_poses

        images, out = self.images, self.out
        if images.background is not None:
            with wrong_usage():
                background_colour(images.background)
        check_folder(out, (self.data,), may_be_map=True)
        working_device(self.device)
        photos = lacks_poses(self.data)
        if photos and (images.depth_unit is not None or images.register_depth is not None):
            raise UsageError(
                f"{self.data}: photos without poses have no depth; leave out --depth-unit and --register-depth"
            )
        if photos and images.masks is not None:
            raise UsageError(
                f"{self.data}: photos without poses; find them with 'bidnerf poses', then train with --masks"
            )
        # What was interrupted during pose estimation resumes by itself.
        resumed = (self.resume or self.finish) and not (photos and not (out / DESCRIPTION).exists())
        if resumed:
            info = self._interrupted()
            images = replace(images, background=images.background or info.bounds.background)
        options = TrainOptions(
            images, self.landmark_features, self.device, self.overwrite, self.refine_poses, self.trust_poses,
            self.depth_points, self.model_points, self.checkpoint_every,
        )  # fmt: skip
        with working():
            if not resumed:
                train(
                    self.data, self.backend or DEFAULT_BACKEND, out, self.config, bake=not self.no_bake, options=options
                )  # fmt: skip
                return
            try:
                resume(out, self.data, bake=not self.no_bake, finish=self.finish, options=options)
            except OtherSettings as error:
                raise UsageError(error) from error

    def _interrupted(self) -> MapInfo:
        """Return the description of the map to resume. Raises ``UsageError`` for options that differ from its own, since they
        would be ignored.
        """
        from bidnerf_core.backend import load_backend
        from bidnerf_core.io import from_plain
        from bidnerf_core.maps import interrupted, longest_side
        from bidnerf_core.settings import to_flat

        out, info = self.out, interrupted(self.out, not self.no_bake)
        if self.backend not in (None, info.backend):
            raise UsageError(f"{out}: uses backend {info.backend!r}, cannot resume it with {self.backend!r}")
        kind: Any = load_backend(info.backend, str(out)).config_type
        began: Any = from_plain(kind, info.config, f"{out}: config")
        usual = kind()
        stored, given, unchanged = (to_flat(settings) for settings in (began, self.config, usual))
        for key, value in given.items():
            if value not in (unchanged[key], stored[key]):
                raise UsageError(
                    f"{out}: was started with {key} {stored[key]}, got {value}; --resume keeps settings, --overwrite"
                    " starts again"
                )
        refinement = info.pose_refinement
        if refinement is not None:  # None: "never", or too few keypoints for any
            refined = refinement.refined or bool(refinement.replaced)
            if self.refine_poses == ("never" if refined else "always"):
                raise UsageError(
                    f"{out}: was started with {'refined' if refined else 'given'} poses, got --refine-poses"
                    f" {self.refine_poses}; --resume keeps the poses"
                )
        largest, features = self.images.largest, self.landmark_features
        if largest is not None and largest != longest_side(info):
            raise UsageError(
                f"{out}: was started with images of {longest_side(info)} px, got --largest {largest}; leave it out"
            )
        if features not in (USUAL_FEATURES, info.landmark_features):
            raise UsageError(
                f"{out}: was started with --landmark-features {info.landmark_features}, got {features}; leave it out"
            )
        return info


def run(arguments: list[str]) -> None:
    parse("train", Train, arguments).run()
