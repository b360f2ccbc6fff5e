"""The public door: what a localizer takes, what it refuses in one line, and that it keeps nothing between calls."""

from __future__ import annotations

import functools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import baked
import tiny
from bidnerf_core import InputError, Localizer, View
from bidnerf_core.evaluation import perturb
from bidnerf_core.geometry import SE3, pose_from_matrix
from bidnerf_core.localization import METHODS, AutoConfig, settings_of
from bidnerf_core.testing import DEVICE, Elsewhere
from bidnerf_hashgrid import backend as hashgrid
from blob_images import BOUNDS, FIELD, FRAME, POSES, TRUTH, photograph
from problems import FieldMap

MAP = FieldMap(FIELD, BOUNDS)
START = perturb(TRUTH, 0.1, 3.0, seed=2)
FEW = settings_of("bid", {"rays": 64, "max_steps": 3, "level": None})
QUICK = AutoConfig(points=500, hypotheses=64, rounds=1, refine_steps=0)


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


COLUMNS = START.matrix().T
MIRRORED = START.matrix().clone()
MIRRORED[:3, 0] *= -1


@pytest.mark.parametrize(
    ("query", "start", "message"),
    [
        (FRAME, COLUMNS, "start has the last row .*, expected .*column-major: transpose it"),
        (FRAME, COLUMNS.numpy(), "start has the last row .*transpose it"),
        (FRAME, torch.eye(3), r"start has shape \(3, 3\), expected a 4x4 matrix T_world_camera"),
        (FRAME, torch.eye(4)[:3], r"start has shape \(3, 4\), expected a 4x4 matrix"),
        (FRAME, [0.0, 0.0, 1.0], r"start has shape \(3,\), expected a 4x4 matrix"),
        (FRAME, 2 * np.eye(4), r"start has the last row \[0.0, 0.0, 0.0, 2.0\], expected \[0, 0, 0, 1\]$"),
        (FRAME, np.diag([2.0, 2.0, 2.0, 1.0]), "start is not a rigid transform"),
        (
            FRAME,
            MIRRORED,
            "start is not a rigid transform, expected an orthonormal rotation of determinant 1",
        ),
        (FRAME, START.matrix() * torch.nan, "start has the last row .*nan"),
        (FRAME, [[1.0, 2.0], [3.0]], "start is a list, expected an SE3 or a 4x4 matrix"),
        (FRAME, "pose.json", "start is a str, expected an SE3 or a 4x4 matrix"),
        (FRAME, [[10**400] * 4] * 4, "start is a list, expected an SE3 or a 4x4 matrix"),
        (FRAME, SE3.stack([START, START]), "start holds 2 poses, expected one"),
        (FRAME, None, "method 'bid' needs a start; give one, or use a method that needs none"),
        (
            [FRAME, FRAME],
            START,
            r"2 frames without relative poses, expected views: View\(frame, T_ref_camera\)",
        ),
        ([View(FRAME, START), FRAME], START, "2 frames without relative poses|expected views"),
        ([], START, "nothing to localize: expected at least one view"),
        ("image.png", START, "query is a str, expected a Frame"),
        (Path("image.png"), START, "query is a PosixPath, expected a Frame"),
        (FRAME.rgb, START, "query is a Tensor, expected a Frame"),
        (FRAME.rgb.numpy(), START, "query is a ndarray, expected a Frame"),
        (None, START, "query is a NoneType, expected a Frame"),
        (["image.png"], START, "query is a list, expected a Frame"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_a_bad_query_is_refused_in_one_line(query: Any, start: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        localizer()(query, start)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("scene", "method", "config", "message"),
    [
        ("maps/room", "auto", None, r"Localizer: got a str, expected a Map; load_map\(folder\) gives one"),
        (Path("maps/room"), "auto", None, r"Localizer: got a PosixPath, expected a Map; load_map\(folder\)"),
        (FIELD, "auto", None, "Localizer: got a GaussianBlobs, expected a Map$"),
        (None, "auto", None, "Localizer: got a NoneType, expected a Map$"),
        (MAP, "icp", None, "no method 'icp'; installed: auto, bid, bid-lm, inerf, inerf-lm"),
        (MAP, "bid", AutoConfig(), "method 'bid' takes a BidConfig or a dictionary, got a AutoConfig"),
        (MAP, "bid", 5, "method 'bid' takes a BidConfig or a dictionary, got a int"),
        (MAP, "bid", {"ray": 5}, "config: BidConfig has no setting 'ray'"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_a_bad_map_or_method_is_refused_when_the_localizer_is_made(
    scene: Any, method: str, config: Any, message: str
) -> None:
    with pytest.raises(InputError, match=message) as raised:
        Localizer(scene, method, config)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("method", METHODS)
def test_settings_are_the_methods_own_by_default(method: str) -> None:
    made = Localizer(MAP, method)
    assert made.config == METHODS[method].config_type()
    assert made.method == method


def test_a_dictionary_changes_the_settings_that_it_names() -> None:
    assert Localizer(MAP, "bid", {"rays": 64, "max_steps": 3, "level": None}, warm_up=False).config == FEW
    given = Localizer(MAP, "bid", {"rays": 64}, preset="paper", warm_up=False).config
    assert given == settings_of("bid", {"rays": 64}, preset="paper")
    with pytest.raises(InputError, match="got both preset 'paper' and a BidConfig"):
        Localizer(MAP, "bid", FEW, preset="paper")


def test_warming_up_changes_no_answer_and_no_random_state() -> None:
    state = torch.get_rng_state()
    cold, warm = (Localizer(MAP, "bid", FEW, warm_up=warm) for warm in (False, True))
    assert torch.equal(torch.get_rng_state(), state)
    one, other = (made(FRAME, START).poses.matrix() for made in (cold, warm))
    assert torch.equal(one, other)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["auto", "bid"])
def test_eight_threads_share_a_localizer(method: str) -> None:
    """Neither the order of calls nor what else is being computed changes an answer."""
    if method == "auto":
        made = Localizer(FieldMap(baked.FIELD, baked.BOUNDS, baked.toy()), "auto", QUICK)
        queries = [(view.frame, None) for view in baked.unseen()] * 2
    else:
        made, queries = localizer(), [(FRAME, perturb(TRUTH, 0.1, 3.0, seed=i)) for i in range(8)]

    def answer(number: int) -> torch.Tensor:
        frame, start = queries[number]
        return made(frame, start, seed=number).poses.matrix()

    alone = [answer(i) for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(answer, range(8)))
    for one, other in zip(alone, together, strict=True):
        assert torch.equal(one, other)


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


def test_a_matrix_with_rounded_numbers_becomes_a_rigid_transform() -> None:
    rounded = torch.tensor(np.round(START.matrix().numpy(), 6))
    assert float((pose_from_matrix(rounded, "start").matrix() - START.matrix()).abs().max()) < 1e-5
    assert bool(pose_from_matrix(rounded, "start").is_rigid())


@pytest.mark.usefixtures("unchecked")
def test_the_name_of_what_is_wrong_opens_the_message() -> None:
    with pytest.raises(InputError, match=r"^pose.json has shape"):
        pose_from_matrix(torch.eye(3), "pose.json")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("seed", [math.nan, -1, 2**70, "x", None, 1.5, True])
def test_a_seed_is_a_whole_number(seed: Any) -> None:
    with pytest.raises(InputError, match=r"^seed is .*, expected a whole number from 0"):
        poses(FRAME, seed=seed)


def test_a_seed_of_numpy_is_that_number() -> None:
    assert torch.equal(poses(FRAME, seed=np.int64(3)), poses(FRAME, seed=3))


@pytest.mark.usefixtures("unchecked")
def test_a_start_is_one_pose_whose_gradient_plays_no_part() -> None:
    expected, matrix = poses(FRAME, start=START), START.matrix()
    learned = SE3(START.rotation.clone().requires_grad_(), START.translation.clone().requires_grad_())
    for start in (learned, matrix.clone().requires_grad_()):
        torch.testing.assert_close(poses(FRAME, start=start), expected, rtol=0, atol=1e-9)
    for start in (
        SE3(torch.eye(2), torch.zeros(2)),
        SE3(torch.eye(3), torch.zeros(4)),
        SE3(torch.eye(3), torch.zeros(())),
    ):
        with pytest.raises(InputError, match=r"^start has a rotation and a translation of shapes"):
            poses(FRAME, start=start)


@pytest.mark.usefixtures("unchecked")
def test_a_method_that_returns_no_localization_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = replace(METHODS["bid"], solve=lambda problem, config, seed: None)  # type: ignore[arg-type, return-value]
    monkeypatch.setattr("bidnerf_core.registry.registered", {("methods", "nothing"): nothing})
    with pytest.raises(InputError, match="method 'nothing' returned a NoneType, expected a Localization"):
        Localizer(MAP, "nothing")(FRAME, START)
