"""Mirror images: they match a map's landmarks only after they are mirrored back, and ``auto`` rejects them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core import Localizer, Outcome, View
from bidnerf_core.localization import LandmarkMatcher, confirm, propose
from bidnerf_core.localization.search.mirrored import MirrorEvidence, mirror_evidence, mirror_image
from bidnerf_core.testing.textured_field import textured_map, unseen


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
    judged = right.rejection(wrong.log10_nfa)
    assert judged is not None
    assert judged.outcome is Outcome.MIRRORED
    assert wrong.rejection(right.log10_nfa) is None


@pytest.mark.parametrize(
    ("image", "mirror", "expected"),
    [
        (-20.0, -29.0, None),  # a mirror image that matches by chance says nothing
        (-10.0, -31.0, Outcome.MIRRORED),
        (-40.0, -81.0, Outcome.MIRRORED),
        (-40.0, -79.0, Outcome.AMBIGUOUS),
        (-59.0, -40.0, Outcome.AMBIGUOUS),
        (-61.0, -40.0, None),
    ],
)
def test_an_image_is_rejected_unless_it_matches_much_better_than_its_mirror_image(
    image: float, mirror: float, expected: Outcome | None
) -> None:
    judged = MirrorEvidence(30, mirror).rejection(image)
    assert (judged and judged.outcome) is expected


def test_a_right_pose_has_the_evidence_of_its_matches_and_a_wrong_one_has_none() -> None:
    view = photo()
    found = propose(matcher(), [view])
    assert found is not None
    T = found.T_world_camera
    there = confirm(matcher(), [view], T).pose
    assert there is not None
    assert there.log10_nfa < 0.8 * found.log10_nfa
    turned = T.retract(torch.tensor([0, 0, 0, 0, 0, 0.5], dtype=torch.float64))
    elsewhere = confirm(matcher(), [view], turned).pose
    assert elsewhere is None or elsewhere.log10_nfa > -10


def test_auto_rejects_a_mirror_image_and_accepts_the_photo() -> None:
    localizer = Localizer(textured_map(surface=True), "auto")
    assert localizer(photo().frame).converged
    found = localizer(in_a_mirror().frame)
    assert not found.converged
    assert found.outcome in (Outcome.MIRRORED, Outcome.TOO_FEW_MATCHES, Outcome.RENDERING_MISMATCH)
    assert found.confidence is None
