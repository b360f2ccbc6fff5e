"""``view``: a map and localizations in it as a page, for a notebook, a file, or the command line."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.datasets import Query, QuerySource
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import Localization, Localizer, SearchRecord, recorded
from bidnerf_core.maps import Map
from bidnerf_core.results import BAD_INPUT
from bidnerf_core.viewer.answer import ShownAnswer, shown_answer
from bidnerf_core.viewer.saving import PageState, page_html, save_page
from bidnerf_core.viewer.scene import shown_map
from bidnerf_core.viewer.table import ShownRow
from bidnerf_core.viewer.trajectories import ShownTrajectory, shown_trajectory

HEIGHT = 620
"""Height (pixels) of the page in a notebook."""


@dataclass(frozen=True, eq=False)
class MapView:
    """The page of a map, which a notebook shows and ``save`` writes to a file."""

    state: PageState

    def __repr__(self) -> str:
        """A one-line description, without the content of the page."""
        return f"<MapView of {self.state.map.name} with {amount(len(self.state.answers), 'localization')}>"

    def _repr_html_(self) -> str:
        """Return the page in an iframe, as notebooks show it."""
        page = html.escape(page_html(self.state), quote=True)
        return f'<iframe srcdoc="{page}" style="width:100%;height:{HEIGHT}px;border:0" sandbox="allow-scripts"></iframe>'

    def save(self, path: str | Path) -> Path:
        """Write the page to a file that opens without a server or a network. Raises ``InputError`` if it cannot be written."""
        return save_page(self.state, path)


def view(
    scene: Map | Localizer,
    localization: Localization | None = None,
    frame: Frame | None = None,
    *,
    trajectory: str | Path | None = None,
    title: str = "",
) -> MapView:
    """Return the page of a map with a localization in it.

    With the ``frame`` that was localized, the page compares it with the map as rendered from the pose. A frame without a
    ``localization`` is localized here, and the page then shows the search too. ``scene`` is a map, or a localizer with settings
    of its own, and ``trajectory`` a file of poses. Raises ``InputError`` if it is neither.
    """
    scene_map = scene.scene if isinstance(scene, Localizer) else scene
    if not isinstance(scene_map, Map):
        raise InputError(
            f"scene is a {type(scene_map).__name__}", where="view", expected="a Map, such as load_map returns"
        )
    answers = list[ShownAnswer]()
    if localization is not None:
        name = "localization" if frame is None else frame.name
        answers.append(shown_answer(scene_map, name, localization, frame))
    elif frame is not None:
        answers.append(
            localized(
                scene if isinstance(scene, Localizer) else Localizer(scene_map),
                Query(frame.name, (View(frame, SE3.identity()),)),
            )
        )
    path = (
        None if trajectory is None else shown_trajectory(Path(trajectory), scene_map.unit, scene_map.origin)
    )
    return MapView(PageState(shown_map(scene_map), tuple(answers), title, trajectory=path))


def localized(
    localizer: Localizer,
    query: Query,
    start: SE3 | None = None,
    seed: int = 0,
    begun: Callable[[SearchRecord], None] | None = None,
    found_pose: Callable[[ShownAnswer], None] | None = None,
) -> ShownAnswer:
    """Localize a query, and return the answer with a record of its search, or an answer that states why the query is unusable.

    ``begun`` is called with the record of the search before it begins, and ``found_pose`` with an answer whose pictures are of
    the surface, before the field is rendered.
    """
    try:
        with recorded() as record:
            if begun is not None:
                begun(record)
            found = localizer(query.views, start, query.depth_rays, seed)
    except InputError as error:
        return ShownAnswer(query.name, BAD_INPUT, False, str(error))
    known = (localizer.scene, query.name, found, query.frame, record, query.truth)
    if found_pose is not None:
        found_pose(shown_answer(*known, quick=True))
    return shown_answer(*known)


def read_and_localized(localizer: Localizer, source: QuerySource, place: int) -> ShownAnswer:
    """Localize the query at index ``place`` of a source; if it cannot be read, the answer states why."""
    try:
        query = source.read(place)
    except InputError as error:
        return ShownAnswer(source.names[place], BAD_INPUT, False, str(error))
    return localized(localizer, query)


def page_of(
    scene: Map, answers: Iterable[ShownAnswer], trajectory: ShownTrajectory | None = None, results: Iterable[ShownRow] = (),
) -> MapView:  # fmt: skip
    """Build the viewer page of a map with answers, a trajectory and rows of results."""
    return MapView(PageState(shown_map(scene), tuple(answers), trajectory=trajectory, results=tuple(results)))
