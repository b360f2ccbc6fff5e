"""The commands ``bidnerf poses`` and ``bidnerf train``."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from bidnerf.cli.options import (
    CameraOptions,
    DaskAddress,
    First,
    ImageOptions,
    Json,
    MapOutput,
    NewMap,
    NewPhotoCamera,
    Overwrite,
    PointChoice,
    StartFile,
    existing,
    installed,
    refuse,
    require_device,
    wrong_usage,
)
from bidnerf.cli.output import check_folder, print_result
from bidnerf.cli.parameters import Flag, Group, Option, SettingsGroup
from bidnerf.cli.running import interruptible_work, report_time
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.registry import USUAL_BACKEND, USUAL_FEATURES, USUAL_POSER
from bidnerf_core.settings import EXPERT, Range

if TYPE_CHECKING:
    from bidnerf_core.camera import CameraSource
    from bidnerf_core.datasets import PosedPhotos
    from bidnerf_core.maps import MapInfo


PoserName: TypeAlias = Annotated[
    str,
    EXPERT,
    installed("posers"),
    Option("NAME", "poser, which finds the poses of photos, one of 'bidnerf plugins posers'"),
]


def workers_of(dask: str | None) -> AbstractContextManager[None]:
    """Return a context in which the workers of the dask scheduler at this address, if any, do the tasks."""
    from bidnerf.evaluation import cluster

    return contextlib.nullcontext() if dask is None else cluster(dask)


@dataclass(frozen=True)
class SearchOptions:
    """How the poses of photos are found."""

    poser: PoserName = USUAL_POSER
    dask: DaskAddress = None
    known: Annotated[
        StartFile,
        EXPERT,
        Option(
            "POSES.json", "rough T_world_camera of some photos by name, in any world, which tell what photos to compare"
        ),
    ] = None

    def find(self, photos: Path, out: Path, camera: CameraSource | Path | None, overwrite: bool) -> PosedPhotos:
        """Find the poses. Raises ``UsageError`` if the poser takes no known ones."""
        from bidnerf.results import read_poses
        from bidnerf_core.datasets import POSERS

        if self.known is None:
            return POSERS.load(self.poser)(photos, out, camera, overwrite)
        if self.poser != USUAL_POSER:
            raise UsageError(f"--known is for the poser {USUAL_POSER}, but --poser is {self.poser}")
        from bidnerf.structure import find_poses

        return find_poses(photos, out, camera, overwrite, known=read_poses(self.known))


def run_poses(
    photos: Annotated[
        Path,
        Option("PHOTOS", "folder of photos, or a video, without poses", positional=True),
        existing("photos or a video"),
    ],
    out: Annotated[Path, Option("DATASET", "folder for the dataset")],
    camera: Annotated[
        Path | None,
        Option(
            "CAMERA.json",
            "file with the intrinsics of all photos, which are then kept fixed",
            "estimated, starting from EXIF",
        ),
        existing("a file with the intrinsics"),
    ] = None,
    overwrite: Overwrite = False,
    json: Json = False,
    *,
    photos_camera: NewPhotoCamera,
    search: Annotated[SearchOptions, Group("search", "How the poses are found.")],
) -> None:
    """Find the poses of photos by structure from motion.

    They are written as a dataset. The dataset refers to the photos in place; its poses.json lists those that were left out, and why. The unit of length is
    arbitrary. Ctrl-C stops, and the same command resumes. 'bidnerf train PHOTOS' performs this step first.
    """
    check_folder(out, (photos,))
    from bidnerf_core.io import to_plain

    given = camera if photos_camera == CameraOptions() else photos_camera.source(camera)
    with workers_of(search.dask), interruptible_work("stopping (Ctrl-C again: at once); what was found is kept"):
        poses = search.find(photos, out, given, overwrite)
    print_result(to_plain(poses), (), json)


def _backend_settings(values: Mapping[str, Any], words: Sequence[str]) -> Any:
    """Return the default settings of the named backend, or of the backend of the map to resume."""
    from bidnerf_core.backend import load_backend, quick_config
    from bidnerf_core.maps import load_info

    name, out, where = values["backend"], values["out"], ""
    if (values["resume"] or values["finish"]) and name is None and isinstance(out, Path):
        with contextlib.suppress(InputError):  # which is reported later
            name, where = load_info(out).backend, str(out)
    backend = load_backend(name or USUAL_BACKEND, where)
    return quick_config(backend) if values["quick"] else backend.config_type()


@dataclass(frozen=True)
class TrainingOptions:
    """Which training, and how far it goes."""

    backend: Annotated[
        str | None, installed("backends"), Option("NAME", "kind of field, one of 'bidnerf backends'", USUAL_BACKEND)
    ] = None
    first: Annotated[First, EXPERT] = None
    quick: Annotated[Flag, Option(None, "train briefly, with the backend's settings for a first map")] = False
    resume: Annotated[Flag, Option(None, "continue the interrupted training in --out")] = False
    finish: Annotated[Flag, Option(None, "end the interrupted training in --out now, with the steps done so far")] = (
        False
    )
    checkpoint_every: Annotated[
        float,
        Range(0.0),
        EXPERT,
        Option("SECONDS", "time between checkpoints: the most work lost if the program is killed"),
    ] = 60.0
    dask: DaskAddress = None


@dataclass(frozen=True)
class PoseOptions:
    """Where poses come from, and what is done about those that are given."""

    refine_poses: Annotated[
        Literal["auto", "always", "never"],
        Option(
            "WHEN",
            "refine the given poses with the keypoints that images share: always, never, or auto (if inconsistent)",
        ),
    ] = "auto"
    poser: PoserName = USUAL_POSER
    trust_poses: Annotated[
        Flag, EXPERT, Option(None, "train even if the given poses contradict most pairs of photos")
    ] = False
    camera: NewPhotoCamera = CameraOptions()


@dataclass(frozen=True)
class DepthPointsOptions:
    """Depth from a sparse model."""

    depth_points: Annotated[
        Path | None,
        EXPERT,
        Option("MODEL", "COLMAP sparse model whose points provide depth for images without any"),
        existing("a COLMAP sparse model"),
    ] = None
    model_points: PointChoice = None


def run_train(
    data: Annotated[
        Path,
        Option("DATA", "folder of a dataset or of photos without poses, or a video", positional=True),
        existing("a dataset, photos or a video"),
    ],
    out: Annotated[Path, Option("MAP", "folder for the map")],
    *,
    training: Annotated[TrainingOptions, Group("training", "Which field is trained, and how long.")],
    target: NewMap,
    given_poses: Annotated[PoseOptions, Group("poses", "What happens to the poses of the dataset.")],
    sparse_depth: Annotated[DepthPointsOptions, Group("sparse depth", "Depth for images that have none.")],
    images: ImageOptions,
    config: Annotated[
        Any,
        SettingsGroup(
            "settings of the backend",
            "The size and the training of the field, for the backend named by --backend.",
            _backend_settings,
            "backends",
        ),
    ] = None,
) -> None:
    """Build a map from a dataset, or from photos without poses.

    Missing poses are found first, as 'bidnerf poses' does, and kept in the folder MAP-poses. The landmarks
    come next, since they localize photos on their own, then the field and the surface. Ctrl-C stops after a step and saves
    the map; --resume continues from there, or from the last checkpoint if the program was killed, with the same result as an
    uninterrupted training, and --finish ends it as it stands. This takes 5 to 10 minutes on two cores for 85 to 436 images with
    poses, and 2 to 4 minutes of CPU time with --quick. If --out holds a map of landmarks alone, as 'bidnerf import' makes
    of a COLMAP model, it gets a field and a surface.
    """
    resumes, bake = training.resume or training.finish, not target.no_bake
    if resumes and target.overwrite:
        name = "--resume" if training.resume else "--finish"
        raise UsageError(f"{name} continues a map, --overwrite starts a new one; expected only one of them")
    if training.finish and not bake:
        raise UsageError("--finish bakes the map, --no-bake does not; expected only one of them")
    check_folder(out, (data,), may_be_map=True)

    from bidnerf_core.datasets import lacks_poses
    from bidnerf_core.io import background_colour
    from bidnerf_core.maps import (
        DESCRIPTION,
        MATCHES,
        MATCHES_STAY,
        OtherSettings,
        TrainOptions,
        resume,
        train,
    )

    if images.background is not None:
        with wrong_usage():
            background_colour(images.background)
    require_device(target.device)
    if given_poses.camera != CameraOptions():
        images = replace(images, camera=given_poses.camera.source(images.camera))
    photos = lacks_poses(data, images)
    if photos:
        given = {"--depth-unit": images.depth_unit, "--register-depth": images.register_depth, "--masks": images.masks}
        refuse(given, f"is for a dataset, but {data} has no poses; 'bidnerf poses' makes a dataset of photos")
    # A run that was interrupted during pose estimation resumes by itself.
    resumes = resumes and not (photos and not (out / DESCRIPTION).exists())
    if resumes:
        info = _interrupted(out, training.backend, config(), target, given_poses, images)
        images = replace(images, background=images.background or info.bounds.background)
    options = TrainOptions(
        images,
        target.landmark_features,
        target.device,
        target.overwrite,
        given_poses.refine_poses,
        given_poses.trust_poses,
        given_poses.poser,
        sparse_depth.depth_points,
        sparse_depth.model_points(),
        training.first,
        training.checkpoint_every,
    )

    def saved() -> str:
        if not (out / DESCRIPTION).exists() and any(out.glob(MATCHES)):
            return f"{out}: stopped; {MATCHES_STAY}"
        if not (out / DESCRIPTION).exists():
            return f"{out}: stopped before anything of the map was saved; the same command starts again"
        return (
            f"{out}: stopped; the map keeps its finished parts and the last checkpoint; `resume` continues, `finish` ends"
            " it as it is"
        )

    with (
        workers_of(training.dask),
        report_time(f"{out}: trained and baked" if bake else f"{out}: trained"),
        interruptible_work(
            "stopping after this step (Ctrl-C again: at once, back to the last checkpoint)", at_once=saved
        ),
    ):
        if resumes:
            try:
                scene = resume(out, data, bake=bake, finish=training.finish, options=options)
            except OtherSettings as error:
                raise UsageError(error) from error
        else:
            scene = train(data, training.backend or USUAL_BACKEND, out, config(), bake=bake, options=options)
    print_result(scene.describe().plain(), (), target.json)


def _interrupted(
    out: Path, backend: str | None, config: Any, target: MapOutput, given_poses: PoseOptions, images: DatasetOptions
) -> MapInfo:
    """Return the description of the map to resume.

    Raises ``UsageError`` for options that differ from those of the map, since they would be ignored.
    """
    from bidnerf_core.backend import load_backend
    from bidnerf_core.io import from_plain
    from bidnerf_core.maps import check_resumable, longest_side
    from bidnerf_core.settings import to_flat

    info = check_resumable(out, not target.no_bake)

    kind: Any = load_backend(info.backend, str(out)).config_type
    stored, unchanged = to_flat(from_plain(kind, info.config, f"{out}: config")), to_flat(kind())
    rows = [(key, value, unchanged[key], stored[key]) for key, value in to_flat(config).items()]
    refinement = info.pose_refinement
    if refinement is not None:  # None: "never", or too few keypoints for refinement
        before = "always" if refinement.refined or refinement.replaced else "never"
        rows.append(("refine_poses", given_poses.refine_poses, "auto", before))
    rows += [
        ("backend", backend, None, info.backend),
        ("largest", images.largest, None, longest_side(info)),
        ("landmark_features", target.landmark_features, USUAL_FEATURES, info.landmark_features),
    ]
    for name, value, usual, stated in rows:
        if value not in (usual, stated):
            raise UsageError(
                f"{out}: was started with `{name}` {stated}, got {value}; `resume` keeps it, `overwrite` starts again"
            )
    return info
