"""``bidnerf view``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from bidnerf_core.camera import CameraSource
from bidnerf_core.cli.camera_options import CameraFile, FieldOfView, FocalLength
from bidnerf_core.cli.folders import check_output
from bidnerf_core.cli.options import Device, MapFolder, Names, option, parse, require
from bidnerf_core.cli.output import console, say, show
from bidnerf_core.cli.progress import counted
from bidnerf_core.cli.queries import FrameOptions, PhotoOptions, open_queries
from bidnerf_core.datasets import DatasetFrames, Query, QuerySource, in_other_split
from bidnerf_core.errors import InputError, UsageError, spelling_hint
from bidnerf_core.results import BAD_INPUT
from bidnerf_core.viewer import PORT, serve_view

if TYPE_CHECKING:
    from bidnerf_core.localization import Localizer
    from bidnerf_core.viewer import ShownAnswer, ShownRow


def run(arguments: list[str]) -> None:
    parse("view", view, arguments)


def view(
    map: MapFolder,
    query: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        option("[QUERY...]", "photos, folders of photos, or one dataset, to localize and show", ""),
    ] = (),
    *,
    save: Annotated[
        Path | None, option("PAGE.html", "write a page that opens without a server or a network, and exit", "")
    ] = None,
    results: Annotated[
        Path | None, option("FILE", "results of 'bidnerf evaluate', as a table with links to their frames", "")
    ] = None,
    trajectory: Annotated[
        Path | None, option("FILE", "poses from 'bidnerf track', or in the format of TUM, EuRoC or KITTI", "")
    ] = None,
    depth: Annotated[tuple[Path, ...], option("FILE...", "depth images of the photos, in the same order or matched by name", "")] = (),
    camera: CameraFile = None,
    focal: FocalLength = None,
    hfov: FieldOfView = None,
    depth_unit: Annotated[float | None, option("METRES", "metres per step of depth images", "")] = None,
    frame: Annotated[Names, option("NAME...", "show only these frames of a dataset, each localized on its own", "all of the split")] = (),
    split: Annotated[str, option("NAME", "split of the dataset; all: every image")] = "test",
    most: Annotated[int, option("N", "largest number of images in a page of --save, spread over all")] = 24,
    method: Annotated[str, option("NAME", "how poses are found, one of 'bidnerf plugins methods'")] = "auto",
    host: Annotated[
        str | None,
        option("ADDRESS", "allow other machines to view the page; they need the address with its token", "this machine only"),
    ] = None,
    port: Annotated[int, option("N", "port to listen on; 0 picks a free one")] = PORT,
    device: Device = "cpu",
) -> None:  # fmt: skip
    """View a map in a browser, drop photos on it, and see how and why a pose was found or rejected. Ctrl-C
    stops it.

    The photos and frames of QUERY can be selected there. Photos dropped on the page take the camera given here, whose field of
    view can be changed there. With --save, QUERY is localized immediately, and the saved page shows the same without a server.
    """
    # Imported when a page is made, since help pages do not need it.
    from bidnerf_core.localization import Localizer
    from bidnerf_core.maps import load_info, load_map
    from bidnerf_core.viewer import page_of, shown_trajectory

    require("--most", most, 1)
    require("--port", port, 0, 65535)
    names = tuple(name for group in frame for name in group)
    if names and not query:
        raise UsageError("--frame names frames of a dataset", expected="the dataset as QUERY")
    if save is not None:
        check_output(save, (*query, *depth, results, trajectory))
    info = load_info(map)
    path = None if trajectory is None else shown_trajectory(trajectory, info.unit, info.origin)
    rows = () if results is None else rows_of(results)
    scene = load_map(map, device)
    localizer = Localizer(scene, method, warm_up=save is None)
    photos = PhotoOptions(depth, CameraSource(camera, focal, hfov, localizer.assumed_cameras), depth_unit)
    source, usual = None, photos.camera
    if query:
        source = open_queries(query, photos, FrameOptions(split), scene.bounds.background, None)
        splits = source.names_by_split if isinstance(source, DatasetFrames) else None
        usual = CameraSource() if isinstance(source, DatasetFrames) else usual
        source = Chosen(source, places_of(source.names, names, most if save else len(source.names), splits))
    if save is not None:
        answers = () if source is None else _localized(localizer, source)
        unread = [answer for answer in answers if answer.outcome == BAD_INPUT]
        if unread and len(unread) == len(answers):
            raise InputError(unread[0].reason)
        for answer in unread:
            say(f"{answer.name}: {answer.reason}")
        with console.status("drawing the map"):
            page_of(scene, answers, path, rows).save(save)
        show(f"look at {save}")
        return
    serve_view(
        localizer,
        source,
        path,
        rows,
        camera=usual,
        host=host,
        port=port,
        ready=lambda address: say(f"look at {address}; Ctrl-C ends"),
    )


def _localized(localizer: Localizer, source: QuerySource) -> tuple[ShownAnswer, ...]:
    from bidnerf_core.viewer import read_and_localized

    answers, count = [], len(source.names)
    with counted("localizing and rendering", "images", count) as report:
        for place in range(count):
            answers.append(read_and_localized(localizer, source, place))
            report(place + 1, count)
    return tuple(answers)


def rows_of(results: Path) -> tuple[ShownRow, ...]:
    """Return the trials in a results file as rows of the page's table."""
    from bidnerf_core.evaluation import read_results
    from bidnerf_core.viewer import shown_row

    return tuple(
        shown_row(
            row.frame, row.method, row.outcome, row.converged, row.reason, row.confidence,
            None if row.error is None else (row.error.translation, row.error.rotation_deg), row.covariance, row.T_world_camera,
        )
        for row in read_results([results])
    )  # fmt: skip


class Chosen:
    """A subset of a source's queries."""

    def __init__(self, source: QuerySource, places: Sequence[int]) -> None:
        self._source, self._places = source, places

    @property
    def names(self) -> Sequence[str]:
        """The names of the chosen queries."""
        return [self._source.names[place] for place in self._places]

    def read(self, place: int) -> Query:
        """Read the chosen query at an index."""
        return self._source.read(self._places[place])


def places_of(
    names: Sequence[str], asked: Sequence[str], most: int, splits: Mapping[str, Sequence[str]] | None = None
) -> list[int]:
    """Return the indices of the requested frames, or of at most ``most`` spread over all; ``splits`` has the names in each."""
    for name in asked:
        if name not in names:
            elsewhere = in_other_split(name, splits or {})
            raise InputError(elsewhere or f"no frame {name!r}{spelling_hint(name, names)}")
    if asked:
        return [names.index(name) for name in asked]
    return list(range(0, len(names), -(-len(names) // most)))
