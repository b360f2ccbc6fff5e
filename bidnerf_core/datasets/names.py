"""The naming of frames, which all readers share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from bidnerf_core.errors import InputError, refuse_text, spelling_hint


def positions(
    names: Sequence[str],
    stems: Sequence[str],
    asked: Sequence[str],
    where: str,
    splits: Callable[[], Mapping[str, Sequence[str]]] = dict,
) -> list[int]:
    """Return the indices of the requested frames in ``names``.

    ``splits`` returns the names in each split, so that the message about a frame of another split can name that split. Raises ``InputError``, whose message begins with ``where``, for a name that is unknown or ambiguous.
    """
    refuse_text(f"{where}: names", asked)
    index = {name: place for place, name in enumerate(names)}
    for name in asked:
        if name not in index:
            if (elsewhere := in_other_split(name, splits())) is not None:
                raise InputError(elsewhere, where=where)
            raise _not_there(where, name, names, stems)
    return [index[name] for name in asked]


def unique_names(paths: Sequence[tuple[str, ...]]) -> list[str]:
    """Return a name for each path (folders, then stem): its stem, prefixed with just enough folders to make it unique."""
    names = [path[-1] for path in paths]
    for depth in range(2, max(map(len, paths), default=0) + 1):
        count = Counter(names)
        names = ["_".join(p[-depth:]) if count[n] > 1 else n for n, p in zip(names, paths, strict=True)]
    return _numbered(names)


def _numbered(names: list[str]) -> list[str]:
    """Return the names with "-2" and so on appended to repeated ones, such as those of a/b.png and a_b.png."""
    used = set(names)
    seen, found = set[str](), list[str]()
    for name in names:
        own, number = name, 2
        while own in seen or (own != name and own in used):
            own, number = f"{name}-{number}", number + 1
        seen.add(own)
        found.append(own)
    return found


def in_other_split(name: str, splits: Mapping[str, Sequence[str]]) -> str | None:
    """Return a clause that names the split of a frame, given the names in each, or None if it is in no split."""
    found = next((split for split, names in splits.items() if name in names), None)
    return found and f"no frame {name!r}, which is in split {found!r}; choose that split"


def _not_there(where: str, name: str, names: Sequence[str], stems: Sequence[str]) -> InputError:
    meant = [other for other, stem in zip(names, stems, strict=True) if stem == name]
    if meant:
        listed = ", ".join(meant[:4]) + (", ..." if len(meant) > 4 else "")
        return InputError(f"frame {name!r} is ambiguous", where=where, expected=f"one of {listed}")
    hint = spelling_hint(name, names)
    expected = f"a name such as {names[0]!r}" if names and not hint else None
    return InputError(
        f"no frame {name!r} among its {len(names)} frames{hint}", where=where, expected=expected
    )
