"""The public door: what a localizer takes, what it refuses in one line, and that it keeps nothing between calls."""

from __future__ import annotations

import base64
import functools
import html
import math
import pickle
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import bidnerf as bn
import tiny
from bidnerf import Cancelled, InputError, Localization, Localizer, View
from bidnerf.testing import textured_map, training_views, unseen
from bidnerf_core.camera import WAYS
from bidnerf_core.geometry import SE3, perturb
from bidnerf_core.localization import METHODS, AutoConfig, settings_of
from bidnerf_core.progress import Progress, job_context
from bidnerf_hashgrid import backend as hashgrid
from blob_images import BOUNDS, FIELD, FRAME, POSES, TRUTH, photograph
from conditions import NOT_RENDERED
from problems import FieldMap
from refusals import refused
from simulated_device import DEVICE, Elsewhere

MAP = FieldMap(FIELD, BOUNDS)
START = perturb(TRUTH, 0.1, 3.0, seed=2)
FEW = settings_of("bid", {"rays": 64, "max_steps": 3, "level": None})


@pytest.fixture(autouse=True)
def judged_on_few_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether a descent is accepted plays no part here, and judging it takes far longer than a few steps."""
    monkeypatch.setattr("bidnerf_bid.methods.RAYS", 16)


@functools.cache
def localizer() -> Localizer:
    return Localizer(MAP, "bid", FEW)


def poses(query: Any, **options: Any) -> torch.Tensor:
    return localizer()(query, **{"start": START, **options}).poses.matrix()


@pytest.mark.usefixtures("unchecked")  # a list of one frame is accepted, but not declared
def test_a_frame_a_view_and_a_list_of_one_are_one_query() -> None:
    """Where a single view stands in its common frame plays no part."""
    expected = poses(FRAME)
    elsewhere = View(FRAME, POSES[2])
    for query in (View(FRAME, SE3.identity()), [FRAME], (FRAME,), [View(FRAME, SE3.identity())]):
        assert torch.equal(poses(query), expected)
    torch.testing.assert_close(poses(elsewhere), expected, rtol=0, atol=1e-9)


def test_several_views_give_the_pose_of_the_last() -> None:
    """Their common frame may be any: the world, the first camera, or one that is turned."""
    turned = SE3.exp(torch.tensor([1.0, 2.0, 3.0, 0.3, 0.2, 0.1], dtype=torch.float64))
    views = [View(photograph(T), T) for T in POSES]
    start = perturb(POSES[-1], 0.1, 3.0, seed=2)
    here = poses(views, start=start)
    there = poses(tuple(replace(v, T_ref_camera=turned @ v.T_ref_camera) for v in views), start=start)
    torch.testing.assert_close(here, there, rtol=0, atol=1e-5)
    assert torch.equal(here[0], start.matrix())
    assert not torch.equal(here[-1], poses(views[-1:], start=start)[-1])


@pytest.mark.parametrize(
    "start",
    [
        START.matrix(),
        START.matrix().float(),
        START.matrix().numpy(),
        START.matrix().numpy().astype(np.float32),
        START.matrix().tolist(),
        tuple(map(tuple, START.matrix().tolist())),
        START.to("cpu", torch.float32),
    ],
    ids=["float64", "float32", "numpy", "numpy float32", "lists", "tuples", "SE3 float32"],
)
def test_a_start_of_any_kind_is_the_same_start(start: Any) -> None:
    torch.testing.assert_close(poses(FRAME, start=start)[0], START.matrix(), rtol=0, atol=1e-6)


def test_an_answer_shows_the_photo_beside_the_map_in_a_notebook() -> None:
    """The picture is that of the pose: it holds the rendering there, small, and needs neither the file nor the frame."""
    found = localizer()(FRAME, START)
    text = found._repr_html_()
    png = base64.b64decode(re.search(r"data:image/png;base64,([^\"]+)", text)[1])  # type: ignore[index]
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].copy()
    photo, rendered, both = torch.from_numpy(picture).float().chunk(3, dim=1)
    small = FRAME.at_most(photo.shape[1])
    torch.testing.assert_close(photo / 255, small.rgb, rtol=0, atol=0.01)
    torch.testing.assert_close(both, (photo + rendered) / 2, rtol=0, atol=1.1)
    assert html.escape(repr(found)) in text
    assert localizer().solve(localizer().problem(FRAME, START))._repr_html_().startswith("<div>&lt;Localization")


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (
            5.0,
            r"without depth: it disagrees with the map, which is 0\.(19|20)\d* times as far: is the depth unit 1 m\?",
        ),
        (0.001, r"which is (99\d|1e\+03) times as far: is the depth unit 1 m\?"),
        (1.0, "fused with depth"),
    ],
)
def test_depth_of_another_unit_is_named(scale: float, words: str) -> None:
    frame = unseen().frame
    assert frame.depth is not None
    given = bn.Frame.from_numpy(frame.rgb_bytes, frame.intrinsics, depth=frame.depth, depth_unit=scale)
    found = Localizer(textured_map(surface=True), warm_up=False)(given)
    assert found.converged
    assert re.search(words, found.reason)
    if scale == 5:
        flat = given.replace(depth=torch.linspace(3.0, 99.0, frame.depth.numel()).reshape(frame.depth.shape))
        assert Localizer(textured_map(surface=True), warm_up=False)(flat).reason.endswith("it disagrees with the map")


def test_an_answer_is_sent_to_another_process_without_its_map() -> None:
    found = localizer()(FRAME, START)
    again = pickle.loads(pickle.dumps(found))
    assert again.plain() == found.plain()
    assert again.picture is None


def test_a_localizer_opens_a_folder_and_names_its_map_in_one_line(tmp_path: Path) -> None:
    scene = bn.train(tiny.views(2), config=tiny.config(2), bake=False).save(tmp_path / "map")
    for given in (tmp_path / "map", str(tmp_path / "map")):
        made = Localizer(given, "bid", warm_up=False)
        assert repr(made) == f"<Localizer in {scene!r} by bid>"
    with refused(where=tmp_path / "none", found="no such folder"):
        Localizer(tmp_path / "none")


COLUMNS = START.matrix().T
MIRRORED = START.matrix().clone()
MIRRORED[:3, 0] *= -1
ROW, MATRIX, POSE = "[0, 0, 0, 1]", "a 4x4 matrix T_world_camera", "an SE3 or a 4x4 matrix"
RIGID, VIEWS = "an orthonormal rotation of determinant 1", "views: View(frame, T_ref_camera)"
TRANSPOSE = f"{ROW}; its last column is, so the matrix is column-major: transpose it"
QUERY = "the file of a photo, its pixels as an array, a Frame, a View, or a list of views"
FOLDER, TAKES = "a Map, or the folder of one", "method 'bid' takes a BidConfig or a dictionary"


@pytest.mark.parametrize(
    ("query", "start", "found", "expected"),
    [
        (FRAME, COLUMNS, f"start has the last row {COLUMNS[3].tolist()}", TRANSPOSE),
        (FRAME, COLUMNS.numpy(), f"start has the last row {COLUMNS[3].tolist()}", TRANSPOSE),
        (FRAME, torch.eye(3), "start has shape (3, 3)", MATRIX),
        (FRAME, torch.eye(4)[:3], "start has shape (3, 4)", MATRIX),
        (FRAME, [0.0, 0.0, 1.0], "start has shape (3,)", MATRIX),
        (FRAME, 2 * np.eye(4), "start has the last row [0.0, 0.0, 0.0, 2.0]", ROW),
        (FRAME, np.diag([2.0, 2.0, 2.0, 1.0]), "start is not a rigid transform", RIGID),
        (FRAME, MIRRORED, "start is not a rigid transform", RIGID),
        (FRAME, np.eye(4) + 1e308 * np.eye(4, k=3), "start is 1e+308 away from the origin", "at most 1e+12"),
        (FRAME, START.matrix() * torch.nan, "start has the last row [nan, nan, nan, nan]", ROW),
        (FRAME, [[1.0, 2.0], [3.0]], "start is a list", POSE),
        (FRAME, "pose.json", "start is a str", POSE),
        (FRAME, [[10**400] * 4] * 4, "start is a list", POSE),
        (FRAME, None, "method 'bid' needs a start; give one, or use a method that needs none", None),
        ([FRAME, FRAME], START, "2 frames without relative poses", VIEWS),
        ([View(FRAME, START), FRAME], START, "2 frames without relative poses", VIEWS),
        ([], START, "nothing to localize:", "at least one view"),
        ("image.png", START, "no such file", "an image file"),
        (Path("image.png"), START, "no such file", "an image file"),
        (FRAME.rgb[0, 0], START, "query is a Tensor", QUERY),
        (np.zeros((2, 3, 4, 3)), START, "query is a ndarray", QUERY),
        (FRAME.rgb, START, "no focal length in EXIF", f"a camera: {WAYS}"),
        (None, START, "query is a NoneType", QUERY),
        (["image.png"], START, "query is a list", QUERY),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_a_bad_query_is_refused_in_one_line(query: Any, start: Any, found: str, expected: str | None) -> None:
    with refused(found=found) as caught:
        localizer()(query, start)
    assert caught.error.expected == expected


@pytest.mark.parametrize(
    ("scene", "method", "config", "where", "found", "expected"),
    [
        (FIELD, "auto", None, "Localizer", "got a GaussianBlobs", FOLDER),
        (None, "auto", None, "Localizer", "got a NoneType", FOLDER),
        (MAP, "icp", None, None, "no method 'icp'; installed: auto, bid, inerf", None),
        (MAP, "bid", AutoConfig(), None, f"{TAKES}, got a AutoConfig", None),
        (MAP, "bid", 5, None, f"{TAKES}, got a int", None),
        (MAP, "bid", {"ray": 5}, "config", "BidConfig has no setting 'ray'", None),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_a_bad_map_or_method_is_refused_when_the_localizer_is_made(
    scene: Any, method: str, config: Any, where: str | None, found: str, expected: str | None
) -> None:
    with refused(where=where, found=found) as caught:
        Localizer(scene, method, config)
    assert caught.error.expected == expected


def test_a_dictionary_changes_the_settings_that_it_names() -> None:
    assert Localizer(MAP, "bid", {"rays": 64, "max_steps": 3, "level": None}, warm_up=False).config == FEW
    given = Localizer(MAP, "bid", {"rays": 64}, preset="paper", warm_up=False).config
    assert given == settings_of("bid", {"rays": 64}, preset="paper")
    with refused(found="got both preset 'paper' and a BidConfig", expected="one"):
        Localizer(MAP, "bid", FEW, preset="paper")


def test_warming_up_changes_no_answer_and_no_random_state() -> None:
    state = torch.get_rng_state()
    cold, warm = (Localizer(MAP, "bid", FEW, warm_up=warm) for warm in (False, True))
    assert torch.equal(torch.get_rng_state(), state)
    one, other = (made(FRAME, START).poses.matrix() for made in (cold, warm))
    assert torch.equal(one, other)


def test_many_queries_have_the_answers_of_each_alone_in_order() -> None:
    """A bad query gives its error, and queries are drawn a few at a time."""
    made, drawn, stages = Localizer(textured_map(), config=NOT_RENDERED), list[int](), list[Progress]()
    frames = [unseen().frame, *(view.frame for view in training_views()[:4])]
    queries: list[Any] = [*frames[:3], Path("missing.png"), *frames[3:]]

    def source() -> Iterator[Any]:
        for number, query in enumerate(queries):
            drawn.append(number)
            yield query

    with job_context(stages.append):
        answers = made.many(source(), seed=3, workers=2)
        found = [next(answers)]
        assert len(drawn) <= 5
        found += answers
    assert [progress.done for progress in stages] == [1, 2, 3, 4, 5, 6]
    for query, answer in zip(queries, found, strict=True):
        if isinstance(query, Path):
            assert isinstance(answer, InputError)
            assert "missing.png" in str(answer)
        else:
            assert isinstance(answer, Localization)
            assert torch.equal(answer.poses.matrix(), made(query, seed=3).poses.matrix())
    assert [answer.name for answer in found if isinstance(answer, Localization)] == [
        query.name or str(number) for number, query in enumerate(queries) if not isinstance(query, Path)
    ]


def test_a_folder_of_photos_is_many_queries(tmp_path: Path) -> None:
    for name in ("10.png", "2.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 8, 3), np.uint8))
    for folder in (tmp_path, str(tmp_path)):
        assert [Path(error.where).name for error in localizer().many(folder)] == ["2.png", "10.png"]
    with refused(where="asks", found="no such folder"):
        localizer().many("asks")
    (tmp_path / "empty").mkdir()
    with refused(where=tmp_path / "empty", found="contains no photos"):
        localizer().many(tmp_path / "empty")


def test_many_queries_can_be_cancelled_and_need_workers() -> None:
    done = list[Any]()
    with job_context(cancel=lambda: len(done) >= 2), pytest.raises(Cancelled):
        list(map(done.append, localizer().many([FRAME] * 9, workers=1)))
    assert len(done) == 2
    with refused(found="workers is 0", expected="at least 1"):
        localizer().many([FRAME], workers=0)


def test_a_device_that_is_another_one_gets_a_copy_of_the_field() -> None:
    field = hashgrid.build(tiny.config(), BOUNDS)
    own = FieldMap(field, BOUNDS)
    before = {name: value.clone() for name, value in field.state_dict().items()}
    with Elsewhere():
        moved = Localizer(own, "bid", device=DEVICE, warm_up=False)
        assert {p.device for p in moved.scene.field.parameters()} == {DEVICE}  # type: ignore[attr-defined]
    assert own.field is field
    assert moved.scene is not own
    assert {p.device.type for p in field.parameters()} == {"cpu"}
    assert all(torch.equal(value, before[name]) for name, value in field.state_dict().items())
    assert Localizer(own, "bid", device="cpu", warm_up=False).scene is own


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("seed", [math.nan, -1, 2**70, "x", None, 1.5, True])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    with refused(found=f"seed is {seed!r}", expected="a whole number from 0"):
        poses(FRAME, seed=seed)


def test_a_seed_of_numpy_is_that_number() -> None:
    assert torch.equal(poses(FRAME, seed=np.int64(3)), poses(FRAME, seed=3))


@pytest.mark.usefixtures("unchecked")
def test_a_start_is_one_pose_whose_gradient_plays_no_part() -> None:
    expected, matrix = poses(FRAME, start=START), START.matrix()
    learned = SE3(START.rotation.clone().requires_grad_(), START.translation.clone().requires_grad_())
    for start in (learned, matrix.clone().requires_grad_()):
        torch.testing.assert_close(poses(FRAME, start=start), expected, rtol=0, atol=1e-9)
    for wrong in (
        SE3.stack([START, START]),
        SE3(torch.eye(3), torch.zeros(4)),
        SE3(torch.eye(3), torch.zeros(())),
    ):
        shapes = f"shapes {tuple(wrong.rotation.shape)} and {tuple(wrong.translation.shape)}"
        with refused(found=f"start has a rotation and a translation of {shapes}", expected="one pose"):
            poses(FRAME, start=wrong)


@pytest.mark.usefixtures("unchecked")
def test_a_method_that_returns_no_localization_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = replace(METHODS["bid"], solve=lambda problem, config, seed: None)  # type: ignore[arg-type, return-value]
    monkeypatch.setattr("bidnerf_core.registry.registered", {("methods", "nothing"): nothing})
    with refused(found="method 'nothing' returned a NoneType", expected="a Localization"):
        Localizer(MAP, "nothing")(FRAME, START)
    with refused(found="method 'nothing' needs a start"):
        Localizer(MAP, "nothing")(FRAME)
