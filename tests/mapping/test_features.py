"""Keypoints: the pixel convention, descriptors as bytes, and images without any."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

import tiny
from bidnerf import SE3, Frame, InputError, Intrinsics, View
from bidnerf_core.mapping import (
    SIFT,
    CachedFeatures,
    DescriptorCells,
    InvertedFile,
    Keypoints,
    Sift,
    byte_of_zero,
    detect,
    image_keypoints,
    limit_features,
    mutual_matches,
    nearest_centre,
    paired_squared_distances,
    quantize,
    smallest,
    squared_distances,
    track_views,
    unrelated_distance,
)
from conditions import CountedDetector


def textured(seed: int) -> torch.Tensor:
    noise = torch.rand((1, 3, 20, 28), generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(noise, (120, 160), mode="bicubic")[0].permute(1, 2, 0).clamp(0, 1)


@pytest.mark.parametrize("centre", [(40.5, 50.5), (71.25, 33.8), (90.0, 60.0)])
def test_a_spot_is_found_at_its_centre(centre: tuple[float, float]) -> None:
    """A bright spot at (u, v), where the first pixel's centre is (0.5, 0.5)."""
    v, u = torch.meshgrid(torch.arange(100) + 0.5, torch.arange(140) + 0.5, indexing="ij")
    spot = torch.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / (2 * 3.0**2))
    found = Sift()((0.1 + 0.8 * spot)[..., None].expand(-1, -1, 3))
    off = (found.pixels - torch.tensor(centre)).norm(dim=-1)
    assert float(off.min()) < 0.06


def test_at_most_the_given_count_and_always_the_same_keypoints() -> None:
    image = textured(0)
    assert 30 <= len(Sift(count=30)(image)) <= 31  # of equal contrast, OpenCV keeps both
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(Sift(), [image] * 4))
    for other in found[1:]:
        assert torch.equal(other.pixels, found[0].pixels)
        assert torch.equal(other.descriptors, found[0].descriptors)


def test_distances_of_bytes_are_exact(generator: torch.Generator) -> None:
    a, b = (torch.randint(0, 256, (n, 128), generator=generator).byte() for n in (7, 9))
    expected = (a[:, None].long() - b.long()).square().sum(-1)
    assert torch.equal(squared_distances(a, b).long(), expected)
    rows, columns = torch.tensor([0, 3, 6]), torch.tensor([8, 1, 0])
    assert torch.equal(paired_squared_distances(a, b, rows, columns).long(), expected[rows, columns])


@pytest.mark.parametrize(("n", "m"), [(700, 300), (2, 600), (600, 1), (0, 5), (5, 0)])
def test_matches_are_mutual_and_unambiguous_in_both_directions(n: int, m: int, generator: torch.Generator) -> None:
    b = torch.randint(0, 256, (m, 8), generator=generator).byte()
    copies = torch.randint(0, max(m, 1), (n,), generator=generator)
    noise = torch.randint(0, 40, (n, 8), generator=generator)
    a = (b[copies].long() + noise).clamp(max=255).byte() if m else torch.zeros((n, 8)).byte()
    distance = (a[:, None].long() - b.long()).square().sum(-1).double()
    expected = (
        {
            (i, j)
            for i, j in enumerate(distance.argmin(1).tolist())
            if all(distance[i, j] < 0.8**2 * line.sort().values[1] for line in (distance[i], distance[:, j]))
        }
        if min(n, m) > 1
        else set()
    )
    rows, columns = mutual_matches(a, b)
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == expected
    assert len(expected) > 20 or min(n, m) < 100


@pytest.mark.parametrize(("block", "rows"), [(65, [3, 3, 1]), (10, [1] * 7)])
def test_nearest_centres_are_found_in_blocks_that_bound_the_memory(
    block: int, rows: list[int], generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    descriptors, centres = (torch.rand((n, 8), generator=generator) for n in (7, 20))
    parts = list[int]()

    def counted(part: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        parts.append(len(part))
        return squared_distances(part, others)

    module = "bidnerf_core.mapping.landmarks.descriptors"
    monkeypatch.setattr(f"{module}.BLOCK", block)
    monkeypatch.setattr(f"{module}.squared_distances", counted)
    found = nearest_centre(descriptors, centres)
    assert torch.equal(found, torch.cdist(descriptors, centres).argmin(1))
    assert parts == rows


def test_root_normalised_descriptors_are_unit() -> None:
    """Their squares are the L1-normalised descriptors, which sum to one: their distance is Hellinger's."""
    root = Sift()(textured(0)).descriptors.double() / 512
    torch.testing.assert_close(root.square().sum(-1), torch.ones(len(root)).double(), atol=0.03, rtol=0)


@pytest.mark.parametrize("signed", [False, True])
def test_zero_and_scale_of_descriptors_are_measured(signed: bool, generator: torch.Generator) -> None:
    exact = torch.randn(4000, 64, generator=generator)
    exact = exact if signed else exact.abs()
    bytes_ = quantize(exact / exact.norm(dim=-1, keepdim=True))
    assert byte_of_zero([bytes_]) == (128 if signed else 0)
    pairs = squared_distances(bytes_[:2000], bytes_[2000:])
    assert unrelated_distance(bytes_) == pytest.approx(float(pairs.mean().sqrt()), rel=0.01)


def test_zero_of_bits_is_half_of_them_and_of_nothing_0(generator: torch.Generator) -> None:
    bits = 32 * torch.randint(0, 2, (500, 256), generator=generator).byte()
    assert byte_of_zero([bits]) == 16
    for few in (bits[:0], bits[:1]):
        assert byte_of_zero([few]) == 0
        assert unrelated_distance(few) == 0


def test_quantising_keeps_the_order_of_signed_descriptors(generator: torch.Generator) -> None:
    exact = torch.randn(40, 64, generator=generator)
    exact = exact / exact.norm(dim=-1, keepdim=True)
    bytes_ = quantize(exact)
    close = torch.cdist(bytes_.float(), bytes_.float()) / 256
    torch.testing.assert_close(close, torch.cdist(exact, exact), atol=0.03, rtol=0)


SOUND = Keypoints(torch.rand(5, 2), torch.ones(5), torch.zeros(5, 8, dtype=torch.uint8))
UNUSABLE: list[tuple[Any, str]] = [
    (None, "returned a NoneType, expected Keypoints"),
    (replace(SOUND, descriptors=np.zeros((5, 8), np.uint8)), "and ndarray, expected tensors"),
    (
        replace(SOUND, descriptors=SOUND.descriptors[:3]),
        r"float32 \[5\] and torch.uint8 \[3, 8\], expected tensors",
    ),
    (replace(SOUND, descriptors=SOUND.descriptors[:, 0]), r"torch.uint8 \[5\], expected tensors"),
    (replace(SOUND, descriptors=SOUND.descriptors.float()), "and torch.float32 .*, expected tensors"),
    (replace(SOUND, pixels=SOUND.pixels * torch.nan), "outside the image of 40x30 pixels"),
    (replace(SOUND, pixels=SOUND.pixels + 40), "outside the image of 40x30 pixels"),
]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("found", "said"), UNUSABLE, ids=range(len(UNUSABLE)))
def test_a_detector_that_returns_no_keypoints_of_the_image_is_refused(found: Any, said: str) -> None:
    def stranger(rgb: torch.Tensor) -> Any:
        return found

    image = torch.zeros(30, 40, 3)
    assert detect(lambda rgb: SOUND, image) is SOUND
    with pytest.raises(InputError, match=f"detector stranger: .*{said}"):
        detect(stranger, image)
    with pytest.raises(InputError, match=f"detector stranger: .*{said}"):
        limit_features(stranger, 3)(image)


def test_descriptors_of_different_lengths_are_refused() -> None:
    lengths = iter((8, 8, 9))

    def stranger(rgb: torch.Tensor) -> Keypoints:
        return replace(SOUND, descriptors=torch.zeros(5, next(lengths), dtype=torch.uint8))

    with pytest.raises(InputError, match="descriptors have 8 and 9 channels in different images"):
        track_views(tiny.views(3), stranger)


def test_equal_images_have_the_same_keypoints_and_others_their_own() -> None:
    detector, image = CountedDetector(), textured(0)
    once = CachedFeatures(detector)
    found = once(image)
    assert once(image) is found
    assert once(image.clone()) is found
    assert once(image.flip(1)) is not found
    assert len(detector.images) == 2
    assert CachedFeatures(detector, [(image, found)])(image) is found
    assert len(detector.images) == 2


def test_bytes_reach_detectors_that_take_them_without_a_detour_through_floats(monkeypatch: pytest.MonkeyPatch) -> None:
    image = (255 * textured(0)).round().to(torch.uint8)
    view = View(Frame("bytes", image, Intrinsics.from_focal(100.0, 160, 120)), SE3.identity())
    floats = CountedDetector()
    image_keypoints(view, floats)
    assert floats.images[0].dtype == torch.float32
    detectors = (SIFT, limit_features(SIFT, 20), limit_features(CachedFeatures(SIFT), 20))
    expected = [detect(detector, view.frame.rgb) for detector in detectors]
    monkeypatch.setattr(type(vars(Frame)["rgb"]), "__get__", lambda *_: pytest.fail("converted to floats"))
    for detector, usual in zip(detectors, expected, strict=True):
        keypoints = image_keypoints(view, detector).keypoints
        assert len(keypoints) >= 20
        assert all(torch.equal(a, b) for a, b in zip(vars(keypoints).values(), vars(usual).values(), strict=True))


def test_an_inverted_file_selects_once_from_all_cells(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    many = torch.randint(0, 256, (5000, 16), generator=generator, dtype=torch.uint8)
    index, selections = InvertedFile(many, DescriptorCells.of(many)), list[int]()

    def counted(distances: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        selections.append(count)
        return smallest(distances, count)

    monkeypatch.setattr("bidnerf_core.mapping.landmarks.descriptors.smallest", counted)
    distance, number = index.nearest(many[:200], 3)
    assert selections == [12, 3]  # cells, then landmarks
    assert torch.equal(number[:, 0], torch.arange(200))
    assert torch.equal(squared_distances(many[:200], many).gather(1, number), distance)
    assert bool((distance.diff(dim=1) >= 0).all())


def test_cells_of_other_descriptors_are_refused(generator: torch.Generator) -> None:
    many = torch.randint(0, 256, (5000, 16), generator=generator, dtype=torch.uint8)
    with pytest.raises(ValueError, match="cells of 5000 descriptors, expected those of the given 4900"):
        InvertedFile(many[100:], DescriptorCells.of(many))
