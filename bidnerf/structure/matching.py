"""Which photos are matched, and their matches: candidates from what is known, votes of large keypoints, two-view geometry.

Candidates are photos that follow each other, that look alike, and that were taken nearby according to GPS or roughly known poses. The
largest keypoints of two candidates vote for them; photos are matched with the candidates with the most votes, and two-view geometry
verifies the matches. Votes and matches are tasks of the job's executor, such as a cluster.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import combinations, groupby
from typing import Any, TypeAlias

import numpy as np
import torch

from bidnerf.structure.colmap import PhotoSet, import_pycolmap
from bidnerf_core.devices import map_tasks
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import Vocabulary, likely_pairs, mutual_matches
from bidnerf_core.progress import counter

EXHAUSTIVE = 60
"""Number of photos up to which all pairs are matched."""
NEIGHBOURS = 10
"""Number of photos before and after each photo, in order of name or time, that are its candidates."""
SIMILAR_PHOTOS, NEAR_PHOTOS = 60, 20
"""Number of photos with the most similar descriptors, and of photos near it by GPS or known poses, the nearest and
every third of those farther away, that are a photo's candidates."""
VOTING_KEYPOINTS = 500
"""Number of a photo's largest keypoints that vote for its candidates. They stay visible when the distance changes."""
PARTNERS = 12
"""Number of candidates with the most votes with which a photo is matched; with those that choose it, there are about 18."""
Pairs: TypeAlias = list[tuple[int, int]]
"""Pairs (i, j) of photos with i < j."""


@dataclass(frozen=True, eq=False)
class StoredKeypoints:
    """What a database holds of a photo: its camera (of pycolmap), and its keypoints, the largest first."""

    camera: Any
    pixels: np.ndarray  # (n, 2)
    descriptors: np.ndarray  # (n, 128), bytes


def candidate_pairs(descriptors: Sequence[np.ndarray], *known: Mapping[int, SE3]) -> Pairs:
    """Return the pairs of photos that may overlap: all of few photos, else neighbours in order, similar photos, and near ones.

    The similarity of two photos is the scalar product of their vectors of locally aggregated descriptors (VLAD, Jégou et al. 2010) of
    ``descriptors`` (n, 128), whose words are found in the photos themselves. Photos are near if rough poses (T_world_camera, by number)
    are, and look the same way; each of the ``known`` sources has a world of its own.
    """
    count = len(descriptors)
    if count <= EXHAUSTIVE:
        return list(combinations(range(count), 2))
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + NEIGHBOURS + 1))}
    tensors = [torch.from_numpy(own.copy()) for own in descriptors]
    vocabulary = Vocabulary.of(tensors)
    vectors = torch.stack([vocabulary.pool(own) for own in tensors])
    partners = [(vectors @ vector).topk(min(SIMILAR_PHOTOS + 1, count)).indices.tolist() for vector in vectors]
    for poses in known:
        numbers = list(poses)
        for first, second in likely_pairs(list(poses.values()), NEAR_PHOTOS).tolist():
            partners[numbers[first]].append(numbers[second])
    pairs |= {(min(i, j), max(i, j)) for i, others in enumerate(partners) for j in others if i != j}
    return sorted(pairs)


def chosen_pairs(descriptors: Sequence[np.ndarray], candidates: Pairs) -> Pairs:
    """Return the pairs of photos to match: of few photos all, else each photo's ``candidates`` with the most votes.

    The votes are the matches (``mutual_matches``) among the largest keypoints.
    """
    if len(descriptors) <= EXHAUSTIVE:
        return candidates
    count = counter("comparing photos", "photos")
    largest = [own[:VOTING_KEYPOINTS] for own in descriptors]
    votes = np.zeros((len(descriptors), len(descriptors)), np.int32)
    grouped = [(i, [j for _, j in pairs]) for i, pairs in groupby(candidates, lambda pair: pair[0])]
    tasks: Any = map_tasks(_votes, ((largest[i], [largest[j] for j in others]) for i, others in grouped))
    with closing(tasks) as results:
        for done, ((i, others), result) in enumerate(zip(grouped, results, strict=True), start=1):
            votes[i, others] = votes[others, i] = result
            count(done, len(grouped))
    best = np.argsort(-votes, axis=1, kind="stable")[:, :PARTNERS]
    wanted = {(min(i, j), max(i, j)) for i, row in enumerate(best.tolist()) for j in row if votes[i, j]}
    return sorted(wanted & set(candidates))


def _votes(own: np.ndarray, others: Sequence[np.ndarray]) -> list[int]:
    """Return the number of keypoints of a photo that each of the ``others`` shows as well, judging by descriptors (n, 128)."""
    return [len(mutual_matches(torch.tensor(own), torch.tensor(other))[0]) for other in others]


def match(database: Any, photos: PhotoSet, pairs: Pairs, pycolmap: Any) -> None:
    """Match the ``pairs`` of photos (by number) that the database lacks, and verify the matches by two-view geometry.

    If the job is cancelled, the matches found so far stay in the database.
    """
    count = counter("matching photos", "pairs")
    todo = [pair for pair in pairs if not database.exists_two_view_geometry(*pair)]
    done = len(pairs) - len(todo)
    count(done, len(pairs))
    cameras = {photo.number: database.read_camera(photo.camera) for photo in photos.photos}

    def stored(number: int) -> StoredKeypoints:
        pixels = database.read_keypoints(number)[:, :2].astype(np.float64)
        return StoredKeypoints(cameras[number], pixels, database.read_descriptors(number).data)

    grouped = [(i, [j for _, j in part]) for i, part in groupby(todo, lambda pair: pair[0])]
    tasks: Any = map_tasks(_geometries, ((stored(i), [stored(j) for j in others]) for i, others in grouped))
    with closing(tasks) as results:
        for (i, others), result in zip(grouped, results, strict=True):
            with pycolmap.DatabaseTransaction(database):
                for j, geometry in zip(others, result, strict=True):
                    database.write_two_view_geometry(i, j, geometry)
            done += len(others)
            count(done, len(pairs))


def _geometries(own: StoredKeypoints, others: Sequence[StoredKeypoints]) -> list[Any]:
    """Match a photo with others; return pycolmap's two-view geometries, whose matches are those that fit them."""
    pycolmap = import_pycolmap("matching photos")
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    descriptors, geometries = torch.tensor(own.descriptors), []
    for other in others:
        matches = torch.stack(mutual_matches(descriptors, torch.tensor(other.descriptors)), dim=-1)
        ends = own.camera, own.pixels, other.camera, other.pixels
        geometries.append(pycolmap.estimate_two_view_geometry(*ends, matches.numpy().astype(np.uint32), verification))
    return geometries
