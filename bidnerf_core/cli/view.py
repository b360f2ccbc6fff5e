"""``bidnerf view``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from bidnerf_core.cli.folders import check_output
from bidnerf_core.cli.options import USUAL_METHOD, Device, MapFolder, Names, require
from bidnerf_core.cli.output import console, say, show
from bidnerf_core.cli.parser import Option, Without, parse
from bidnerf_core.cli.progress import displayed
from bidnerf_core.cli.queries import QueryOptions
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.errors import InputError, UsageError, spelling_hint
from bidnerf_core.progress import counter
from bidnerf_core.viewer import PORT

if TYPE_CHECKING:
    from bidnerf_core.datasets import Query, QuerySource
    from bidnerf_core.localization import Localizer
    from bidnerf_core.viewer import ShownAnswer, ShownRow


@dataclass(frozen=True)
class View:
    """View a map in a browser, drop photos on it, and see how and why a pose was found or rejected. Ctrl-C stops it.

    The photos and frames of QUERY can be selected there. Photos dropped on the page take the camera given here, whose field of
    view can be changed there. With --save, QUERY is localized immediately, and the saved page shows the same without a server.
    """

    map: MapFolder
    query: Annotated[
        tuple[Path, ...],
        Option(
            "[QUERY...]", "photos, folders of photos, or one dataset, to localize and show", positional=True
        ),
    ] = ()
    save: Annotated[
        Path | None, Option("PAGE.html", "write a page that opens without a server or a network, and exit")
    ] = None
    results: Annotated[
        Path | None, Option("FILE", "results of 'bidnerf evaluate', as a table with links to their frames")
    ] = None
    trajectory: Annotated[
        Path | None, Option("FILE", "poses from 'bidnerf track', or in the format of TUM, EuRoC or KITTI")
    ] = None
    frame: Annotated[
        Names,
        Option(
            "NAME...", "show only these frames of a dataset, each localized on its own", "all of the split"
        ),
    ] = ()
    most: Annotated[int, Option("N", "largest number of images in a page of --save, spread over all")] = 24
    method: Annotated[str, Option("NAME", "how poses are found, one of 'bidnerf plugins methods'")] = (
        USUAL_METHOD
    )
    host: Annotated[
        str | None,
        Option(
            "ADDRESS",
            "allow other machines to view the page; they need the address with its token",
            "this machine only",
        ),
    ] = None
    port: Annotated[int, Option("N", "port to listen on; 0 picks a free one")] = PORT
    device: Device = "cpu"
    queries: Annotated[QueryOptions, Without("frame", "window")] = QueryOptions()
    images: Annotated[
        DatasetOptions, Without("register_depth", "masks", "mask_hides", "largest", "background")
    ] = DatasetOptions(split="test")

    def __post_init__(self) -> None:
        require("--most", self.most, 1)
        require("--port", self.port, 0, 65535)
        if self.frame and not self.query:
            raise UsageError("--frame names frames of a dataset", expected="the dataset as QUERY")

    def run(self) -> None:
        from bidnerf_core.camera import CameraSource
        from bidnerf_core.datasets import DatasetFrames
        from bidnerf_core.localization import Localizer
        from bidnerf_core.maps import load_info, load_map
        from bidnerf_core.viewer import LiveView, page_of, serve_view, shown_trajectory

        if self.save is not None:
            check_output(self.save, (*self.query, *self.queries.depth, self.results, self.trajectory))
        info = load_info(self.map)
        path = None if self.trajectory is None else shown_trajectory(self.trajectory, info.unit, info.origin)
        rows = () if self.results is None else rows_of(self.results)
        scene = load_map(self.map, self.device)
        localizer = Localizer(scene, self.method, warm_up=self.save is None)
        source = None
        camera = self.queries.camera.source(self.images, localizer.assumed_cameras)
        if self.query:
            source = self.queries.open(
                self.query, self.images, scene.bounds.background, localizer.assumed_cameras
            )
            splits = source.names_by_split if isinstance(source, DatasetFrames) else {}
            camera = CameraSource() if isinstance(source, DatasetFrames) else camera
            for name in self.frame:
                if name not in source.names:
                    raise _no_frame(name, source.names, splits)
            step = -(-len(source.names) // self.most) if self.save else 1
            places = [source.names.index(name) for name in self.frame] or range(0, len(source.names), step)
            source = Chosen(source, places)
        if self.save is None:
            serve_view(
                LiveView(localizer, source, path, rows, camera), host=self.host, port=self.port,
                ready=lambda address: say(f"look at {address}; Ctrl-C ends"),
            )  # fmt: skip
            return
        answers = () if source is None else _localized(localizer, source)
        with console.status("drawing the map"):
            page_of(scene, answers, path, rows).save(self.save)
        show(f"look at {self.save}")


def _no_frame(name: str, names: Sequence[str], splits: dict[str, list[str]]) -> InputError:
    from bidnerf_core.datasets import in_other_split

    return InputError(in_other_split(name, splits) or f"no frame {name!r}{spelling_hint(name, names)}")


def _localized(localizer: Localizer, source: QuerySource) -> tuple[ShownAnswer, ...]:
    """Localize all queries. Raises ``InputError`` if none of them can be read."""
    from bidnerf_core.results import BAD_INPUT
    from bidnerf_core.viewer import read_and_localized

    answers, total = [], len(source.names)
    with displayed():
        count = counter("localizing and rendering", "images")
        for place in range(total):
            answers.append(read_and_localized(localizer, source, place))
            count(place + 1, total)
    unread = [answer for answer in answers if answer.outcome == BAD_INPUT]
    if unread and len(unread) == len(answers):
        raise InputError(unread[0].reason)
    for answer in unread:
        say(f"{answer.name}: {answer.reason}")
    return tuple(answers)


def rows_of(results: Path) -> tuple[ShownRow, ...]:
    """Return the trials in a results file as rows of the page's table."""
    from bidnerf_core.evaluation import read_results
    from bidnerf_core.viewer import ShownRow

    return tuple(map(ShownRow.of, read_results([results])))


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


def run(arguments: list[str]) -> None:
    parse("view", View, arguments).run()
