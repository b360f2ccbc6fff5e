"""Matching the keypoints of pairs of photos, and verifying the matches by two-view geometry, using COLMAP."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bidnerf_core.progress import counter
from bidnerf_core.structure.keypoints import key
from bidnerf_core.structure.pairs import Pairs


def match(database: Path, numbers: Sequence[int], pairs: Pairs, threads: int, pycolmap: Any) -> None:
    """Match the ``pairs`` of photos that are missing from the database; ``numbers`` are the photos' numbers there.

    Matches found until the job is cancelled are stored. A batch, which cannot be interrupted, takes about two seconds.
    """
    count = counter("matching photos", "pairs")
    with pycolmap.Database.open(database) as stored:
        todo = [(i, j) for i, j in pairs if not stored.exists_two_view_geometry(numbers[i], numbers[j])]
    done, size = len(pairs) - len(todo), 32
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    listed = database.with_name("pairs.txt")
    count(done, len(pairs))
    while todo:
        batch, todo = todo[:size], todo[size:]
        listed.write_text("".join(f"{key(numbers[i])} {key(numbers[j])}\n" for i, j in batch))
        began = time.monotonic()
        pycolmap.match_image_pairs(
            database, matching, pycolmap.ImportedPairingOptions(match_list_path=listed), verification,
            device=pycolmap.Device.cpu,
        )  # fmt: skip
        each = (time.monotonic() - began) / len(batch)
        size = max(1, min(2 * size, round(2 / max(each, 1e-6))))
        done += len(batch)
        count(done, len(pairs))


class Overlaps:
    """Which photos overlap according to a database's matches."""

    def __init__(self, database: Any, pycolmap: Any) -> None:
        self.partners: Counter[int] = Counter()  # number of photos that each overlaps with, by number
        self.pairs = self.from_one_place = 0
        still = [
            int(getattr(pycolmap.TwoViewGeometryConfiguration, name))
            for name in ("PANORAMIC", "PLANAR_OR_PANORAMIC")
        ]
        for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
            if not len(geometry.inlier_matches):
                continue
            self.partners.update(pycolmap.pair_id_to_image_pair(pair))
            self.pairs += 1
            self.from_one_place += int(geometry.config) in still
