"""``bidnerf localize`` in several maps: the map that an image shows, the runner-up, and the pose."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bidnerf_core.cli.interruptions import uninterrupted
from bidnerf_core.cli.output import print_json, say, show
from bidnerf_core.cli.progress import counted
from bidnerf_core.datasets import Query, QuerySource, find_reader
from bidnerf_core.errors import InputError, UsageError, enumeration
from bidnerf_core.geometry import symbol
from bidnerf_core.io import IMAGE_SUFFIXES
from bidnerf_core.maps import MapCollection, maps_in
from bidnerf_core.results import (
    Answer,
    Answers,
    Failure,
    localize_each,
    pose_format,
    standard_deviations,
)


def named_maps(first: Path, others: Sequence[Path]) -> tuple[list[Path], tuple[Path, ...]]:
    """Split the arguments into the maps, or folders of maps, that they begin with, and the queries after them."""
    count = 0
    while count < len(others) and _holds_maps(others[count]):
        count += 1
    return [first, *others[:count]], tuple(others[count:])


def no_query(maps: Sequence[Path]) -> UsageError:
    """Return the error for arguments that all count as maps: no query is among them, or it comes first."""
    expected = "image files, folders of photos, or a folder of a dataset"
    first, *others = maps
    if not others:
        return UsageError("no QUERY", expected=expected)
    if first.exists() and not maps_in(first):
        return UsageError(
            f"{str(first)!r} is not a map, but {str(others[0])!r} is: MAP comes first, then QUERY"
        )
    return UsageError(
        f"{enumeration([repr(str(path)) for path in maps])} are maps, and no QUERY follows them;",
        expected=expected,
    )


def _holds_maps(path: Path) -> bool:
    found = maps_in(path)
    if not found or found == [path]:
        return bool(found)
    images = any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir())
    return not images and find_reader(path) is None


def collected(maps: Sequence[Path], method: str, config: Any) -> MapCollection:
    """Read the landmarks of all maps, with a progress display."""
    with counted("reading", "maps", max(1, sum(len(maps_in(path)) for path in maps))) as report:
        return MapCollection(list(maps), method, config, progress=lambda p: report(p.done, p.total))


def check_for_several(given: dict[str, bool], out: Path | None) -> None:
    """Raise ``UsageError`` for given options that apply only to one map, and for a pose file other than JSON."""
    for option, is_given in given.items():
        if is_given:
            raise UsageError(f"{option} applies to one map, but several are given")
    if out is not None and pose_format(out) != ".json":
        raise UsageError("poses in several maps have different worlds", where=out, expected="a .json file")


def localize_in_several(
    maps: MapCollection, source: QuerySource, seed: int, out: Path | None, json: bool
) -> None:
    """Localize each query in the map that it shows, print the answers, and write them to ``out``.

    Raises ``InputError`` if a query failed.
    """
    answers, total = Answers(maps), len(source.names)

    def answered(query: Query, answer: Answer | Failure) -> None:
        if isinstance(answer, Failure):
            say(f"{answer.name}: {answer.reason}")
        if json:
            print_json(answers.plain(answer))
        elif isinstance(answer, Answer):
            _show(answer, total == 1)

    try:
        with counted("localizing", "images", total) as report:
            localize_each(
                maps, source, seed=seed, answers=answers, each=answered,
                progress=lambda p: report(p.done, p.total),
            )  # fmt: skip
    finally:
        with uninterrupted():
            if out is not None and answers.given:
                answers.save(out)
    if total > 1:
        say(f"{len(answers.accepted)} of {total} converged in {len(maps)} maps")
    if failed := len(answers) - len(answers.answers):
        raise InputError(f"{failed} of {total} queries could not be read or localized, see above")


def _show(answer: Answer, full: bool) -> None:
    placement, found = answer.placement, answer.found
    assert placement is not None
    where = f"in {placement.map}" if found.converged else f"in none of the maps; nearest {placement.map}"
    verdict = "converged" if found.converged else f"NOT converged: {found.outcome.value}"
    show(f"{answer.name}: {where}: {verdict} ({found.reason})")
    if placement.runner_up is not None:
        name, other = placement.runner_up
        rival = "converged too" if other.converged else str(other.outcome)
        show(f"  runner-up {name}: {rival} ({other.reason})")
    if not full:
        return
    if found.covariance is not None:
        position, rotation = standard_deviations(found.covariance)
        show(
            f"  uncertainty  {position:.4f} {symbol(found.unit)}, {57.29578 * rotation:.3f} deg (one standard deviation)"
        )
    show(f"  T_world_camera (in the frame of {placement.map}; lengths in {found.unit})")
    for row in found.T_world_camera.matrix().tolist():
        show("    " + " ".join(f"{value: .6f}" for value in row))
