"""The viewer's page: what it says of a localization, and that it is whole, closed and safe."""

from __future__ import annotations

import hashlib
import html
import math
import re
from base64 import b64decode
from dataclasses import fields, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

import bidnerf.viewer
import viewed
from bidnerf import SE3, InputError, Intrinsics, Localization, Localizer, Map, View, view
from bidnerf.results import PosedImage, write_poses
from bidnerf.scenes import closed_form_map, orbit
from bidnerf.viewer import trajectory_json

# Inside: what a page states of one answer is read from its parts, without a browser
from bidnerf.viewer.answer import MOST_STEPS, answer_json, depth_difference, ellipsoid
from bidnerf.viewer.evidence import EARLIER, HERE, MEASURES, acceptance_figures, bar, contests
from bidnerf.viewer.pages import MapView, answer_query
from bidnerf.viewer.pictures import field_image, pack_points, quick_image
from bidnerf.viewer.scene import map_json, turn_towards
from bidnerf_core.datasets import Query
from bidnerf_core.errors import Cancelled
from bidnerf_core.fields import render_image
from bidnerf_core.localization import (
    ADVICE,
    LANDMARK_BOUNDS,
    METHODS,
    Bound,
    Evidence,
    Outcome,
    SearchRecord,
    Support,
    record_search,
)
from bidnerf_core.mapping import States
from bidnerf_core.progress import job_context
from commands import Run, assert_refused
from optional import require


@pytest.fixture(scope="module")
def localizer(room: Map) -> Localizer:
    return Localizer(room)


@pytest.fixture(scope="module")
def query() -> Query:
    return viewed.query()


@pytest.fixture(scope="module")
def recording(localizer: Localizer, query: Query) -> tuple[Localization, SearchRecord]:
    """A localization of the photo, and the record of its search."""
    with record_search() as record:
        answer = localizer(query.views)
    return answer, record


@pytest.fixture(scope="module")
def answer(recording: tuple[Localization, SearchRecord]) -> Localization:
    return recording[0]


@pytest.fixture(scope="module")
def record(recording: tuple[Localization, SearchRecord]) -> SearchRecord:
    return recording[1]


def largest_error(shown: dict[str, Any]) -> float:
    """The largest distance between a keypoint and its landmark's projection, of those that agree, by the image's size."""
    seen, there = (
        np.frombuffer(b64decode(part["base64"]), np.float32).reshape(-1, 2)
        for part in (shown["matches"]["keypoints"], shown["matches"]["projections"])
    )
    agree = np.frombuffer(b64decode(shown["matches"]["accepted"]["base64"]), np.uint8) > 0
    return float(np.abs(seen - there)[agree].max())


@pytest.fixture(scope="module")
def found(localizer: Localizer, query: Query) -> dict[str, Any]:
    return answer_query(localizer, query)


@pytest.fixture(scope="module")
def refused(localizer: Localizer) -> dict[str, Any]:
    return answer_query(localizer, viewed.query(viewed.HOSTILE, seed=5))


def test_a_trajectory_in_another_unit_than_the_map_is_remarked(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "bidnerf")
    image = PosedImage("a", 0, Intrinsics(50, 50, 32, 24, 64, 48), SE3.identity(), time=1.0, unit="units")
    for ending in ("json", "tum"):
        write_poses(tmp_path / f"path.{ending}", [image])
        for unit in ("units", None):
            trajectory_json(tmp_path / f"path.{ending}", unit)
        assert not caplog.text
        trajectory_json(tmp_path / f"path.{ending}", "metres")
        assert f"path.{ending}: is in units, but the map is in metres" in caplog.text
        caplog.clear()


def test_an_accepted_pose_passes_its_figures(found: dict[str, Any]) -> None:
    assert found["accepted"]
    assert found["error"][0] < 0.02
    assert all(figure["passed"] is not False for figure in found["figures"])
    assert found["matches"]["agreeing"] > 100
    assert largest_error(found) < 0.05
    assert [step["caption"] for step in found["steps"]][-1] == "the pose found"
    for part in ("ellipsoid", "observed", "rendered", "depth"):
        assert found[part] is not None, part


def test_the_answer_is_described_once_and_its_field_rendered_afterwards(localizer: Localizer, query: Query) -> None:
    before = list[Any]()
    answer = answer_query(localizer, query, follow=lambda record, shown: before.append(shown))
    assert before[0] is None  # the search begins
    assert {key for key in answer if answer[key] is not before[1][key]} == {"rendered", "depth"}


def test_a_refused_pose_fails_a_figure_and_shows_its_search(refused: dict[str, Any]) -> None:
    assert not refused["accepted"]
    assert any(figure["passed"] is False for figure in refused["figures"])
    assert max(len(step["scores"]) for step in refused["steps"]) > 50  # the hypotheses of the search on the surface
    assert refused["runner_up"] is not None


def test_every_part_of_the_evidence_is_a_figure() -> None:
    """The number of matches by chance and the way in which a pose was found are in others."""
    parts = {part.name for part in fields(Evidence)} - {"by_chance", "searched"} | {"above_chance"}
    assert set(MEASURES) == parts
    assert {bound.measure for bound in LANDMARK_BOUNDS} <= parts


@pytest.mark.parametrize("bound", LANDMARK_BOUNDS, ids=lambda bound: bound.measure)
def test_each_bound_that_is_not_kept_is_the_first_figure(answer: Localization, bound: Bound) -> None:
    evidence = answer.diagnostics
    assert isinstance(evidence, Evidence)
    broken = {bound.measure: bound.limit - 1 if bound.is_least else bound.limit + 1}
    if bound.measure == "above_chance":
        broken = {"by_chance": (1 + evidence.inliers) / (bound.limit - 1) - 1}
    figures = acceptance_figures(replace(answer, diagnostics=replace(evidence, **broken)), None)
    failed = [figure["name"] for figure in figures if figure["passed"] is False]
    assert failed == [figures[0]["name"]] == [MEASURES[bound.measure][0]]


def test_a_mirrored_photo_is_compared_with_its_mirror_image(localizer: Localizer, query: Query) -> None:
    """Its matches are drawn where the photo shows them."""
    mirrored = query.frame.replace(rgb=query.frame.rgb.flip(1), depth=None)
    shown = answer_query(localizer, Query("mirrored", (View(mirrored, SE3.identity()),)))
    assert shown["outcome"] == Outcome.MIRRORED
    assert "mirror image" in shown["contests"][0]["question"]
    assert shown["contests"][0]["answers"][0]["name"] == "the mirror image"
    assert shown["matches"]["agreeing"] > 100
    assert largest_error(shown) < 0.05


def test_another_place_is_a_contest_a_step_and_the_runner_up(
    room: Map, answer: Localization, record: SearchRecord
) -> None:
    """A second mode of the posterior, 2 m aside, that is less likely."""
    found = record.answers[-1]
    posterior, T = found.posterior, found.posterior.states.T
    aside = replace(T, translation=T.translation + torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64))
    states = States.cat([posterior.states, replace(posterior.states, T=aside, mode=posterior.states.mode + 1)])
    probability = torch.cat([0.75 * posterior.probability, 0.25 * posterior.probability])
    update = torch.cat([posterior.update, posterior.update])
    both = replace(posterior, states=states, probability=probability, update=update)
    modes = [*found.modes, replace(found.modes[0], name="another place")]
    doubtful = SearchRecord(record.steps, [replace(found, modes=modes, posterior=both)])
    shown = answer_json(room, "a", answer, record=doubtful)
    here, there = shown["contests"][0]["answers"]
    assert (here["name"], there["name"]) == (HERE, "a pose 2 m away")
    assert (here["probability"], there["probability"]) == (pytest.approx(0.75), pytest.approx(0.25))
    assert shown["runner_up"]["pose"] == there["pose"]
    assert shown["runner_up"]["probability"] == pytest.approx(0.25)
    assert shown["steps"][-2]["scores"] == pytest.approx((-math.log(0.75), -math.log(0.25)))


def test_a_bar_is_beyond_its_middle_on_the_side_that_passes(found: dict[str, Any], refused: dict[str, Any]) -> None:
    figures = [figure for answer in (found, refused) for figure in answer["figures"] if figure["bar"]]
    assert {figure["passed"] for figure in figures} == {True, False}
    for figure in figures:
        value, at_least = figure["bar"]["value"], figure["bar"]["at_least"]
        assert figure["passed"] is (value >= 0.5 if at_least else value <= 0.5), figure
        assert 0 <= value <= 1
        assert at_least is figure["threshold"].startswith("at least")
    near = require(bar(3.22, 3.0, at_least=False))
    assert math.isclose(near["value"] / 0.5, 3.22 / 3.0)
    assert bar(1.47, 0.25, at_least=False) == {"value": 1.0, "at_least": False}
    assert bar(math.nan, 3.0, True) is None


def test_a_refusal_says_what_to_try_and_a_method_what_it_is(found: dict[str, Any], refused: dict[str, Any]) -> None:
    assert found["advice"] == ""
    assert refused["advice"] == ADVICE[Outcome(refused["outcome"])].first
    assert found["method_summary"] == METHODS["auto"].summary


def test_poses_are_shown_relative_to_the_origin_of_the_map(
    tmp_path: Path, room: Map, query: Query, answer: Localization
) -> None:
    origin = (500_000.0, 4_000_000.0, 100.0)
    offset = torch.tensor(origin, dtype=torch.float64)
    surveyed, far = replace(room, info=replace(room.info, origin=origin)), answer.translated(offset)
    shown = answer_json(surveyed, query.name, far, truth=far.T_world_camera)
    local = answer.T_world_camera.matrix().flatten().tolist()
    assert shown["pose"] == pytest.approx(local, abs=1e-6)
    assert shown["truth"] == pytest.approx(local, abs=1e-6)
    assert "500,000" in dict(map_json(surveyed, 0)["facts"])["origin"]
    write_poses(tmp_path / "path.txt", [PosedImage("a", 0, query.frame.intrinsics, far.T_world_camera)])
    drawn = trajectory_json(tmp_path / "path.txt", origin=origin)["poses"]
    rows = np.frombuffer(b64decode(drawn["base64"]), np.float32).reshape(-1)
    assert rows == pytest.approx(local[:12], abs=1e-3)


def test_the_loss_of_a_descent_is_the_first_figure(answer: Localization) -> None:
    said = Support({"plain": 5.0, "displaced": -3.0, "other": 9.0, "confidence": 0.05, "mean_loss": 0.036})
    lost = replace(answer, confidence=0.05, diagnostics=said)
    first = acceptance_figures(lost, None)[0]
    assert (first["name"], first["value"]) == ("mean loss", "0.036")
    assert (first["threshold"], first["passed"]) == ("at most 0.02", False)
    assert "not even a local optimum" in contests(lost, None)[0]["note"]


def test_a_descent_is_shown_step_by_step_with_its_loss(room: Map, answer: Localization) -> None:
    T, losses = SE3.stack([*viewed.walk(500), answer.T_world_camera]), torch.linspace(0.5, 0.1, 500)
    steps = answer_json(room, "descent", replace(answer, poses=T, losses=losses))["steps"]
    assert len(steps) <= MOST_STEPS + 1
    assert [steps[0]["caption"], steps[-1]["caption"]] == ["step 0 of 500", HERE]
    assert [step["loss"] for step in steps] == sorted((step["loss"] for step in steps if step["loss"]), reverse=True)
    assert steps[0]["loss"] == 0.5


def test_an_earlier_pose_by_landmarks_is_told_from_the_pose_found(
    room: Map, query: Query, answer: Localization, record: SearchRecord
) -> None:
    here = answer_json(room, "here", answer, query.frame, record)
    assert (
        {figure["pose"] for figure in here["figures"]} == {here["matches"]["pose"] if here["matches"] else None} == {""}
    )
    away = replace(answer.T_world_camera, translation=answer.T_world_camera.translation + 1.0)
    given_up = replace(answer, T_world_camera=away, diagnostics=None, confidence=None)
    there = answer_json(room, "there", given_up, query.frame, record)
    assert (
        {figure["pose"] for figure in there["figures"]}
        == {there["matches"]["pose"] if there["matches"] else None}
        == {EARLIER}
    )
    assert EARLIER in next(each["note"] for each in there["contests"] if not each["of_pose"])


def test_a_localization_is_not_recorded_unless_asked_for(
    localizer: Localizer, query: Query, answer: Localization, record: SearchRecord
) -> None:
    steps = len(record.steps)
    without = localizer(query.views)
    assert len(record.steps) == steps > 0
    assert torch.equal(answer.T_world_camera.matrix(), without.T_world_camera.matrix())


def test_the_ellipsoid_is_that_of_two_standard_deviations_in_the_world(generator: torch.Generator) -> None:
    root = torch.randn((6, 6), generator=generator, dtype=torch.float64)
    covariance = root @ root.mT
    T = SE3.exp(torch.randn(6, generator=generator, dtype=torch.float64))
    found = require(ellipsoid(T, covariance))
    axes = torch.tensor(found["axes"], dtype=torch.float64).reshape(3, 3)
    world = T.rotation @ covariance[:3, :3] @ T.rotation.mT
    torch.testing.assert_close(axes.mT @ axes, 4 * world)
    assert found["lengths"] == sorted(found["lengths"], reverse=True)
    assert ellipsoid(T, torch.full((6, 6), torch.nan)) is None
    assert ellipsoid(T, None) is None


def test_depth_difference_is_the_offset_of_a_shifted_measurement(room: Map, query: Query) -> None:
    image, frame = room.render(query.views[0]), query.frame
    shifted = require(
        depth_difference(image, replace(frame, depth=torch.where(image.depth > 0.3, image.depth - 0.25, 0)))
    )
    assert math.isclose(shifted["median"], 0.25, rel_tol=1e-4)
    assert depth_difference(image, replace(frame, depth=None)) is None


def test_normals_point_to_the_side_of_the_cameras(generator: torch.Generator) -> None:
    places = torch.nn.functional.normalize(torch.randn((200, 3), generator=generator), dim=-1)
    signs = torch.randn((200, 1), generator=generator).sign()
    inside, outside = (
        torch.zeros((1, 3)),
        5 * torch.eye(3).repeat(2, 1) * torch.tensor([[1.0]] * 3 + [[-1.0]] * 3),
    )
    torch.testing.assert_close(turn_towards(places, signs * places, inside), -places)
    torch.testing.assert_close(turn_towards(places, signs * places, outside), places)
    torch.testing.assert_close(turn_towards(places, places, places[:0]), places)


def test_packed_points_are_exact_to_a_part_in_65535(generator: torch.Generator) -> None:
    points = 1000 + 7 * torch.randn((50, 3), generator=generator, dtype=torch.float64)
    found = pack_points(points)
    places = np.frombuffer(b64decode(found["places"]["base64"]), "<u2").reshape(-1, 3)
    back = np.array(found["lower"]) + places / 65535 * found["size"]
    assert np.abs(back - points.numpy()).max() <= found["size"] / 65535
    assert pack_points(points[:0])["places"]["shape"] == (0, 3)


def test_the_page_holds_its_state_and_hostile_names_stay_text(
    room: Map, found: dict[str, Any], refused: dict[str, Any]
) -> None:
    page = MapView(map_json(room, 2), (found, refused), title=viewed.HOSTILE).html()
    assert viewed.HOSTILE not in page
    assert page.count("</script>") == 3  # of the state, of three.js and of the modules
    held = viewed.state_of(page)
    assert [answer["name"] for answer in held["answers"]] == ["unseen", viewed.HOSTILE]
    assert len(held["map"]["cameras"]) == 8
    assert held["map"]["unit"] == "m"


def test_the_page_asks_nobody_for_anything(room: Map, found: dict[str, Any]) -> None:
    page = MapView(map_json(room, 0), (found,)).html()
    policy = require(re.search(r'Content-Security-Policy" content="([^"]*)"', page))
    assert "default-src 'none'" in policy[1]
    assert "connect-src 'none'" in policy[1]
    script = require(re.search(r"script-src ([^;]*);", policy[1]))
    assert "unsafe" not in script[1]
    assert not re.search(r'(?:src|href)="(?!data:)[^"]', page.partition("<script>")[0])


def test_the_scripts_are_bundled_from_the_present_sources() -> None:
    folder = Path(bidnerf.viewer.__file__).parent / "page"
    sources = sorted(file for file in folder.glob("*.js") if not file.name.endswith(".min.js"))
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in sources)).hexdigest()
    assert (folder / "page.min.js").read_text().splitlines()[-1] == f"// sources: {digest}", "run 'make page'"


def test_a_notebook_shows_the_page_in_a_frame_that_cannot_reach_it(room: Map, query: Query) -> None:
    shown = view(room, frame=query.frame)
    markup = shown._repr_html_()
    assert 'sandbox="allow-scripts"' in markup
    source = require(re.search(r'srcdoc="([^"]*)"', markup))
    assert viewed.state_of(html.unescape(source[1]))["answers"][0]["outcome"] == "converged"
    assert "1 localization" in repr(shown)


def test_a_localization_of_an_earlier_run_is_shown_without_its_frame(
    room: Map, answer: Localization, tmp_path: Path
) -> None:
    answer.save(tmp_path / "pose.json")
    shown = answer_json(room, "earlier", Localization.load(tmp_path / "pose.json"))
    assert shown["accepted"]
    assert shown["rendered"] is None
    assert shown["figures"][0]["name"] == "confidence"


def test_what_is_no_map_or_cannot_be_localized_is_refused(room: Map, query: Query) -> None:
    with pytest.raises(InputError, match="start"):
        view(Localizer(room, "bid", warm_up=False), frame=query.frame)
    with pytest.raises(InputError, match="expected a Map"):
        view("room")  # type: ignore[arg-type]


def test_view_saves_a_page_of_photos(bidnerf: Run, room: Map, tmp_path: Path) -> None:
    photo, page = viewed.photo_file(tmp_path), tmp_path / "page.html"
    place, none = ["view", room.folder, photo], tmp_path / "none.png"
    for wrong, status in ((tmp_path / "page.txt", 2), (photo, 2)):
        assert_refused(bidnerf(*place, "--save", wrong), status, wrong, after_remarks=True)
    nothing = bidnerf("view", room.folder, none, "--save", page)
    assert_refused(nothing, 1, none, after_remarks=True)
    assert not page.exists()
    some = bidnerf(*place, none, "--save", page).succeed()
    assert str(none) in some.err
    assert f"loading {room.folder}" in some.err.splitlines()
    good, bad = viewed.state_of(page.read_text())["answers"]
    assert (good["name"], good["accepted"]) == ("photo", True), good["reason"]
    assert not bad["accepted"]
    assert "none.png" in bad["reason"]  # the page says what is wrong, too


@pytest.mark.parametrize("contracted", [False, True])
def test_the_field_is_seen_from_beyond_the_reach_of_the_images_rays(contracted: bool) -> None:
    """The first view of a page shows the map from outside."""
    blobs = closed_form_map("blobs")
    scene = replace(blobs, info=replace(blobs.info, bounds=replace(blobs.bounds, contracted=contracted)))
    near, distance = orbit(3.5, 1)[0], 5 * scene.bounds.far
    away = replace(near, translation=near.translation * distance / near.translation.norm())
    camera = Intrinsics.from_hfov(2 * math.degrees(math.atan(max(scene.bounds.size) / distance)), 32, 32)
    background = torch.tensor(scene.bounds.background)
    assert float(((field_image(scene, camera, away) - background).abs() > 0.05).float().mean()) > 0.02


def test_the_field_is_seen_from_nearer_than_the_images_saw_it(room: Map) -> None:
    """Rays begin before the nearest matter, which the surface tells, however far the images were from it."""
    pose, camera = viewed.walk(3)[1], Intrinsics.from_hfov(60, 16, 9)
    from_afar = replace(room, info=replace(room.info, bounds=replace(room.bounds, near=0.99 * room.bounds.far)))
    assert render_image(from_afar.field, camera, pose, from_afar.bounds).opacity.max() < 0.1
    torch.testing.assert_close(field_image(from_afar, camera, pose), field_image(room, camera, pose), atol=0.1, rtol=0)


def test_a_rendering_is_the_fields_and_stops_when_it_is_not_wanted(room: Map) -> None:
    scene, pose = room, viewed.walk(3)[1]
    camera = Intrinsics.from_hfov(60, 160, 90)
    whole = render_image(scene.field, camera, pose, scene.bounds).rgb
    cancelled = Mock(side_effect=[False, False, True])
    in_pieces = field_image(scene, camera, pose)
    torch.testing.assert_close(in_pieces, whole, atol=1e-5, rtol=0)
    with pytest.raises(Cancelled), job_context(cancel=cancelled):
        field_image(scene, camera, pose)
    assert cancelled.call_count == 3
    assert quick_image(scene, camera, pose).shape == whole.shape
    assert quick_image(replace(scene, surface=None), camera, pose).equal(in_pieces)
