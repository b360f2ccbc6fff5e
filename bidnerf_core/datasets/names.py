"""The naming of frames, which all readers share."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence


def unique_names(paths: Sequence[tuple[str, ...]]) -> list[str]:
    """Return a name for each path (folders, then stem): its stem, prefixed with just enough folders to make it unique.

    Names that are still the same, such as those of a/b.png and a_b.png, get the endings "-2" and so on.
    """
    names = [path[-1] for path in paths]
    for depth in range(2, max(map(len, paths), default=0) + 1):
        count = Counter(names)
        names = ["_".join(p[-depth:]) if count[n] > 1 else n for n, p in zip(names, paths, strict=True)]
    used, seen = set(names), dict[str, None]()
    for name in names:
        own, number = name, 2
        while own in seen or (own != name and own in used):
            own, number = f"{name}-{number}", number + 1
        seen[own] = None
    return list(seen)


def in_other_split(name: str, splits: Mapping[str, Sequence[str]]) -> str | None:
    """Return a clause that names the split of a frame, given the names in each, or None if it is in no split."""
    found = next((split for split, names in splits.items() if name in names), None)
    return found and f"no frame {name!r}, which is in split {found!r}; choose that split"
