"""Mirror images: they match a map's landmarks only after they are mirrored back, and ``auto`` rejects them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core import Localizer, Outcome, View
from bidnerf_core.localization import LandmarkMatcher, confirm, mirror_image, propose, rig
from bidnerf_core.localization.alternatives import decide, mirror_evidence
from bidnerf_core.testing import textured_map, unseen


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
    (_, wrong), (_, right) = (mirror_evidence(matcher(), view) for view in (in_a_mirror(), photo()))
    assert right < -50
    assert right < wrong - 40


@pytest.mark.parametrize(
    ("image", "mirror", "expected"),
    [
        (-20.0, -9.0, None),  # a mirror image that matches by chance says nothing
        (-10.0, -41.0, Outcome.MIRRORED),
        (-40.0, -81.0, Outcome.MIRRORED),
        (-40.0, -59.0, Outcome.AMBIGUOUS),
        (-59.0, -40.0, Outcome.AMBIGUOUS),
        (-81.0, -40.0, None),
    ],
)
def test_an_image_is_rejected_unless_it_matches_much_better_than_its_mirror_image(
    image: float, mirror: float, expected: Outcome | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf_core.localization.alternatives.mirror_evidence", lambda *_: (30, mirror))
    problem = rig(textured_map(), [photo()], None, matcher=matcher())
    found = propose(matcher(), [photo()])
    assert found is not None
    found = replace(found, log10_nfa=image)
    rejection = decide(problem, found.T_world_camera, found, rays=0, seed=0).rejection
    assert (rejection and rejection.outcome) is expected


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
