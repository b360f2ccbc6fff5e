"""Mirror images: they match a map's landmarks only after they are mirrored back, and ``auto`` rejects them."""

from __future__ import annotations

from dataclasses import replace

import torch

from bidnerf_core import Localizer, Outcome, View
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.search.mirrored import mirror_evidence, mirror_image
from textured_field import textured_map, unseen


def matcher() -> LandmarkMatcher:
    landmarks = textured_map().landmarks
    assert landmarks is not None
    return LandmarkMatcher(landmarks)


def photo() -> View:
    return replace(unseen(), frame=replace(unseen().frame, depth=None))


def in_a_mirror() -> View:
    return replace(photo(), frame=mirror_image(photo().frame))


def test_mirroring_twice_gives_the_frame() -> None:
    frame = photo().frame
    twice = mirror_image(mirror_image(frame))
    assert torch.equal(twice.rgb, frame.rgb)
    assert twice.intrinsics == frame.intrinsics


def test_only_the_mirror_image_of_a_mirror_image_matches() -> None:
    right, wrong = (mirror_evidence(matcher(), [view]) for view in (in_a_mirror(), photo()))
    assert right.log10_nfa < -50
    assert right.log10_nfa < wrong.log10_nfa - 40
    assert right.contradicts(wrong.log10_nfa)
    assert not wrong.contradicts(right.log10_nfa)


def test_auto_rejects_a_mirror_image_and_accepts_the_photo() -> None:
    localizer = Localizer(textured_map(surface=True), "auto")
    assert localizer(photo().frame).converged
    found = localizer(in_a_mirror().frame)
    assert not found.converged
    assert found.outcome in (Outcome.MIRRORED, Outcome.TOO_FEW_MATCHES, Outcome.RENDERING_MISMATCH)
