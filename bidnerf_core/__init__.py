"""bidnerf: estimate the 6-DoF pose of RGB-D images in a radiance field of any kind."""

from __future__ import annotations

import importlib
import os
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

# OpenMP threads that wait should sleep. On cores shared with other work, spinning made training more than ten times
# slower in measurements. It has to be set before torch is loaded; a user's own setting is kept.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# When they are imported, torch and typeguard (which the command line's parser uses) look for plugins among all entry
# points, and fail if any package has a malformed file. Where there is such a file, they are imported without plugins.
try:
    entry_points(group="bidnerf.backends")
except Exception:
    os.environ.setdefault("TORCH_DEVICE_BACKEND_AUTOLOAD", "0")
    os.environ.setdefault("TYPEGUARD_DISABLE_PLUGIN_AUTOLOAD", "1")

if TYPE_CHECKING:
    from bidnerf_core.backend import RecipeBackend as RecipeBackend
    from bidnerf_core.backend import load_backend as load_backend
    from bidnerf_core.camera.intrinsics import Intrinsics as Intrinsics
    from bidnerf_core.datasets import Dataset as Dataset
    from bidnerf_core.datasets import FrameSequence as FrameSequence
    from bidnerf_core.datasets import open_dataset as open_dataset
    from bidnerf_core.datasets import open_sequence as open_sequence
    from bidnerf_core.datasets import write_transforms as write_transforms
    from bidnerf_core.errors import Cancelled as Cancelled
    from bidnerf_core.errors import InputError as InputError
    from bidnerf_core.errors import InputWarning as InputWarning
    from bidnerf_core.evaluation.comparison import Comparison as Comparison
    from bidnerf_core.evaluation.evaluate import compare as compare
    from bidnerf_core.evaluation.evaluate import evaluate as evaluate
    from bidnerf_core.evaluation.protocols import perturb as perturb
    from bidnerf_core.evaluation.results import ResultTable as ResultTable
    from bidnerf_core.fields.contract import FieldValues as FieldValues
    from bidnerf_core.fields.contract import HitField as HitField
    from bidnerf_core.fields.contract import RadianceField as RadianceField
    from bidnerf_core.fields.contract import RayHits as RayHits
    from bidnerf_core.fields.contract import Rays as Rays
    from bidnerf_core.fields.contract import RaySampler as RaySampler
    from bidnerf_core.fields.contract import RaySamples as RaySamples
    from bidnerf_core.fields.contract import SceneBounds as SceneBounds
    from bidnerf_core.fields.contract import levels as levels
    from bidnerf_core.fields.observations import Observations as Observations
    from bidnerf_core.fields.rendering import render as render
    from bidnerf_core.fields.rendering import render_image as render_image
    from bidnerf_core.fields.residuals import DEPTH_RESIDUALS as DEPTH_RESIDUALS
    from bidnerf_core.fields.sampling import Stratified as Stratified
    from bidnerf_core.frames.frame import Frame as Frame
    from bidnerf_core.frames.frame import View as View
    from bidnerf_core.geometry.se3 import SE3 as SE3
    from bidnerf_core.localization import AutoConfig as AutoConfig
    from bidnerf_core.localization import Localization as Localization
    from bidnerf_core.localization import Localizer as Localizer
    from bidnerf_core.localization import Outcome as Outcome
    from bidnerf_core.localization import Tracker as Tracker
    from bidnerf_core.localization import TrackerConfig as TrackerConfig
    from bidnerf_core.localization import settings_of as settings_of
    from bidnerf_core.localization.corrector import Corrector as Corrector
    from bidnerf_core.mapping import BakeConfig as BakeConfig
    from bidnerf_core.maps.collection import MapCollection as MapCollection
    from bidnerf_core.maps.collection import Placement as Placement
    from bidnerf_core.maps.extending import extend as extend
    from bidnerf_core.maps.importers import ImportedField as ImportedField
    from bidnerf_core.maps.importing import import_map as import_map
    from bidnerf_core.maps.map import Map as Map
    from bidnerf_core.maps.map import load_map as load_map
    from bidnerf_core.maps.rendering import RenderingScores as RenderingScores
    from bidnerf_core.maps.rendering import rendering_scores as rendering_scores
    from bidnerf_core.maps.scaling import ScaleFit as ScaleFit
    from bidnerf_core.maps.scaling import factor_of_distance as factor_of_distance
    from bidnerf_core.maps.scaling import factor_of_poses as factor_of_poses
    from bidnerf_core.maps.summary import MapSummary as MapSummary
    from bidnerf_core.maps.training import resume as resume
    from bidnerf_core.maps.training import train as train
    from bidnerf_core.progress import Progress as Progress
    from bidnerf_core.progress import ProgressCallback as ProgressCallback
    from bidnerf_core.registry import list_plugins as list_plugins
    from bidnerf_core.registry import load_plugin as load_plugin
    from bidnerf_core.registry import register as register
    from bidnerf_core.results.errors import PoseError as PoseError
    from bidnerf_core.results.errors import pose_error as pose_error
    from bidnerf_core.results.export import export_map as export_map
    from bidnerf_core.results.overlays import overlay as overlay
    from bidnerf_core.results.pose_files import PosedImage as PosedImage
    from bidnerf_core.results.pose_files import read_pose as read_pose
    from bidnerf_core.results.pose_files import read_poses as read_poses
    from bidnerf_core.results.pose_files import read_positions as read_positions
    from bidnerf_core.results.pose_files import write_poses as write_poses
    from bidnerf_core.results.tracked_path import TrackedPath as TrackedPath
    from bidnerf_core.results.tracked_path import track as track
    from bidnerf_core.scenes.closed_form_data import closed_form_data as closed_form_data
    from bidnerf_core.scenes.closed_form_data import closed_form_map as closed_form_map
    from bidnerf_core.service.client import ServiceClient as ServiceClient
    from bidnerf_core.service.client import ServiceError as ServiceError
    from bidnerf_core.service.server import serve as serve
    from bidnerf_core.service.server import service_app as service_app
    from bidnerf_core.service.settings import ServiceLimits as ServiceLimits
    from bidnerf_core.structure.poses import find_poses as find_poses
    from bidnerf_core.structure.record import FoundPoses as FoundPoses
    from bidnerf_core.training import Supervision as Supervision
    from bidnerf_core.training import SupervisionConfig as SupervisionConfig
    from bidnerf_core.viewer.view import MapView as MapView
    from bidnerf_core.viewer.view import view as view

HOMES = {
    "AutoConfig": "localization",
    "BakeConfig": "mapping",
    "Cancelled": "errors",
    "Comparison": "evaluation.comparison",
    "Corrector": "localization.corrector",
    "DEPTH_RESIDUALS": "fields.residuals",
    "Dataset": "datasets",
    "FieldValues": "fields.contract",
    "FoundPoses": "structure.record",
    "Frame": "frames.frame",
    "FrameSequence": "datasets",
    "HitField": "fields.contract",
    "ImportedField": "maps.importers",
    "InputError": "errors",
    "InputWarning": "errors",
    "Intrinsics": "camera.intrinsics",
    "Localization": "localization",
    "Localizer": "localization",
    "Map": "maps.map",
    "MapCollection": "maps.collection",
    "MapSummary": "maps.summary",
    "MapView": "viewer.view",
    "Observations": "fields.observations",
    "Outcome": "localization",
    "Placement": "maps.collection",
    "PoseError": "results.errors",
    "PosedImage": "results.pose_files",
    "Progress": "progress",
    "ProgressCallback": "progress",
    "RadianceField": "fields.contract",
    "RayHits": "fields.contract",
    "RaySampler": "fields.contract",
    "RaySamples": "fields.contract",
    "Rays": "fields.contract",
    "RecipeBackend": "backend",
    "RenderingScores": "maps.rendering",
    "ResultTable": "evaluation.results",
    "SE3": "geometry.se3",
    "ScaleFit": "maps.scaling",
    "SceneBounds": "fields.contract",
    "ServiceClient": "service.client",
    "ServiceError": "service.client",
    "ServiceLimits": "service.settings",
    "Stratified": "fields.sampling",
    "Supervision": "training",
    "SupervisionConfig": "training",
    "TrackedPath": "results.tracked_path",
    "Tracker": "localization",
    "TrackerConfig": "localization",
    "View": "frames.frame",
    "closed_form_data": "scenes.closed_form_data",
    "closed_form_map": "scenes.closed_form_data",
    "compare": "evaluation.evaluate",
    "evaluate": "evaluation.evaluate",
    "import_map": "maps.importing",
    "export_map": "results.export",
    "extend": "maps.extending",
    "factor_of_distance": "maps.scaling",
    "factor_of_poses": "maps.scaling",
    "find_poses": "structure.poses",
    "levels": "fields.contract",
    "list_plugins": "registry",
    "load_backend": "backend",
    "load_map": "maps.map",
    "load_plugin": "registry",
    "open_dataset": "datasets",
    "open_sequence": "datasets",
    "overlay": "results.overlays",
    "perturb": "evaluation.protocols",
    "pose_error": "results.errors",
    "read_pose": "results.pose_files",
    "read_poses": "results.pose_files",
    "read_positions": "results.pose_files",
    "register": "registry",
    "render": "fields.rendering",
    "render_image": "fields.rendering",
    "rendering_scores": "maps.rendering",
    "resume": "maps.training",
    "serve": "service.server",
    "service_app": "service.server",
    "settings_of": "localization",
    "track": "results.tracked_path",
    "train": "maps.training",
    "view": "viewer.view",
    "write_poses": "results.pose_files",
    "write_transforms": "datasets",
}
"""Module that defines each public name. Modules are imported on first use (PEP 562): importing torch takes
seconds, and ``bidnerf --help`` does not need it. A new name needs a line here and one above, for tools that
do not run the code."""

__all__ = sorted(HOMES)


def __getattr__(name: str) -> Any:
    if name not in HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(f"{__name__}.{HOMES[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
