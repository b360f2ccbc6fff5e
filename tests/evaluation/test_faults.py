"""Faults: each does what its name says, by as much as its size says, and leaves everything else alone."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import label

from bidnerf.evaluation import FAULTS, NO_FAULT, expand_faults, faulty, parse_faults, rolling_shutter
from bidnerf.scenes import demo_object, demo_room, orbit
from bidnerf.scenes import views as seen_from
from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, look_at, random_units
from optional import require
from refusals import refused

CAMERA = Intrinsics(70.0, 72.0, 41.0, 29.5, 80, 60)
BYTE = 1.0001 / 255
"""The step of colours, which are rounded to bytes, and what the arithmetic of floats adds."""
LENS = dataclasses.replace(CAMERA, distortion=(0.05, -0.01, 0.001, 0.002))
INSIDE = look_at((1.2, -0.9, 1.6), (-1.0, 0.5, 0.6))
"""A pose in the demo's room."""
every_fault = pytest.mark.parametrize("name", FAULTS)


@pytest.fixture(scope="module")
def view() -> View:
    """A view of an object before a background, with alpha and a distorted lens; some pixels measure nothing."""
    (seen,) = seen_from(demo_object(), LENS, orbit(2.6, 1, seed=4))
    alpha = (require(seen.frame.depth) > 0).float()
    assert 0.2 < float(alpha.mean()) < 0.9
    return View(dataclasses.replace(seen.frame, alpha=alpha), seen.T_ref_camera)


def plain(value: float = 2.0, rgb: float = 0.4, camera: Intrinsics = CAMERA) -> View:
    """A grey image of a plane that is parallel to it."""
    size = camera.height, camera.width
    frame = Frame("plain", torch.full((*size, 3), rgb), camera, torch.full(size, value))
    return View(frame, SE3.identity())


def places(fault: str, seed: int) -> torch.Tensor:
    """Return which (column, row) of an image each pixel shows with a fault, as alpha channels tell, which are not rounded."""
    centres, size = CAMERA.pixel_centres(), torch.tensor([CAMERA.width, CAMERA.height])
    frames = [plain().frame.replace(alpha=part) for part in (centres / size).unbind(-1)]
    return torch.stack([alpha_of(faulty(View(f, SE3.identity()), fault, seed)) for f in frames], -1) * size


def same(a: Frame, b: Frame) -> bool:
    """Whether two frames have equal images and cameras."""
    pairs = [(getattr(a, name), getattr(b, name)) for name in ("rgb", "depth", "alpha")]
    return a.intrinsics == b.intrinsics and all(x is y is None or torch.equal(x, y) for x, y in pairs)


def depth_of(view: View) -> torch.Tensor:
    return require(view.frame.depth)


def alpha_of(view: View) -> torch.Tensor:
    return require(view.frame.alpha)


# All faults.


def test_at_its_neutral_size_a_fault_is_not_applied(view: View) -> None:
    for name, fault in FAULTS.items():
        assert (fault.neutral is None) == (name == "jpeg")
        if fault.neutral is not None:
            assert faulty(view, f"{name}:{fault.neutral:.12g}", 3) is view


@pytest.mark.parametrize("name", [name for name in FAULTS if name.startswith("depth-")])
def test_a_fault_of_depth_changes_depth_alone(name: str, view: View) -> None:
    """That faults change something, and by their seed alone, is in their contract."""
    for size in FAULTS[name].sizes:
        changed = faulty(view, f"{name}:{size}", 3).frame
        assert torch.equal(changed.rgb, view.frame.rgb)
        assert changed.intrinsics == view.frame.intrinsics


@pytest.mark.parametrize(
    "fault",
    [
        "depth-noise:0.02",
        "depth-noise-squared:0.01",
        "depth-holes:0.5",
        "depth-hole:0.5",
        "depth-shift:4",
        "depth-rows:1",
        "depth-window:9",
        "principal-point:5",
        "rolling-shutter:2",
        "occluder:0.2",
        "occluder-unmeasured:0.2",
        "moved:0.2",
        "added:0.2",
        "vanished:0.2",
        "covered",
    ],
)
def test_random_choices_depend_on_seed_and_frame(fault: str, view: View) -> None:
    first = faulty(view, fault, 0).frame
    assert not same(faulty(view, fault, 1).frame, first)
    renamed = View(dataclasses.replace(view.frame, name="another"), view.T_ref_camera)
    assert not same(faulty(renamed, fault, 0).frame, first)


@every_fault
def test_images_without_depth_have_every_fault_but_those_of_depth(name: str, view: View) -> None:
    fault, size = FAULTS[name], FAULTS[name].sizes[-1]
    blind = View(dataclasses.replace(view.frame, depth=None), view.T_ref_camera)
    if fault.needs_depth:
        with refused(found=f"frame {view.frame.name} has no measured depth"):
            faulty(blind, f"{name}:{size}", 0)
        return
    changed = faulty(blind, f"{name}:{size}", 0).frame
    assert changed.depth is None
    assert torch.equal(changed.rgb, faulty(view, f"{name}:{size}", 0).frame.rgb)


@every_fault
def test_sizes_out_of_range_are_refused(name: str) -> None:
    fault = FAULTS[name]
    with refused(
        found=f"fault {name} has no size",
        expected=f"NAME:SIZE such as depth-scale:1.02; its unit is: {fault.unit}",
    ):
        parse_faults(f"{name}:")
    beyond = [x for x in (fault.allowed.least - 1, fault.allowed.most + 1) if math.isfinite(x)]
    for size, found in [
        *((f"{x:.12g}", f"{x:.12g}") for x in beyond),
        *((word, repr(word)) for word in ("nan", "inf", "much")),
    ]:
        with refused(where=f"fault {name}", found=f"size is {found}", expected=fault.allowed):
            parse_faults(f"{name}:{size}")


# Words.


def test_words_name_single_and_composed_faults() -> None:
    words = ["none", "depth-scale:0.98,1.020", "mirror", "exposure:.7+blur:3"]
    assert expand_faults(words) == (
        "none",
        "depth-scale:0.98",
        "depth-scale:1.02",
        "mirror:1",
        "exposure:0.7+blur:3",
    )
    assert expand_faults([]) == ()
    assert [str(part) for part in parse_faults("exposure:0.7+blur:3")] == ["exposure:0.7", "blur:3"]
    assert parse_faults(NO_FAULT) == ()


@pytest.mark.parametrize(
    ("word", "found", "expected"),
    [
        ("depth-scal:1.02", "no fault 'depth-scal', did you mean 'depth-scale'?", None),
        ("gravity:2", "no fault 'gravity'; installed: added, blur,", None),
        ("depth-scale", "fault depth-scale has no size", "NAME:SIZE"),
        ("mirror:", "fault mirror has no size", "NAME:SIZE"),
        ("mirror:0.5", "size is 0.5", "a whole number, 0 to 1"),
        ("jpeg:50.5", "size is 50.5", "a whole number, 1 to 100"),
        ("depth-scale:0", "size is 0", "more than 0, at most 100"),
        ("blur:1,1", "fault blur:1 is given twice", "different ones"),
        ("blur:1+blur:2", "fault blur:1+blur:2 has blur twice", "each once"),
        ("none+blur:1", "no fault 'none'", None),
        ("", "no fault ''", None),
    ],
)
def test_bad_words_are_explained(word: str, found: str, expected: str | None) -> None:
    with refused(found=found, expected=expected):
        expand_faults([word])


def test_composed_faults_are_applied_in_turn_with_the_same_random_choices(view: View) -> None:
    one = faulty(view, "depth-noise:0.01", 5)
    both = faulty(view, "exposure:0.5+depth-noise:0.01", 5)
    assert torch.equal(depth_of(one), depth_of(both))
    assert torch.equal(both.frame.rgb, faulty(view, "exposure:0.5", 5).frame.rgb)
    darker = faulty(view, "exposure:2+vignetting:0.5", 0).frame.rgb  # white is cut off before the corners darken
    brighter = faulty(view, "vignetting:0.5+exposure:2", 0).frame.rgb
    assert bool((darker <= brighter + BYTE).all())
    assert bool((darker < brighter - 0.01).any())


# Depth.


def test_scale_and_offset_are_exact(view: View) -> None:
    depth, hit = depth_of(view), depth_of(view) > 0
    assert torch.equal(depth_of(faulty(view, "depth-scale:1.02", 0)), depth * 1.02)
    moved = depth_of(faulty(view, "depth-offset:0.25", 0))
    assert torch.equal(moved[hit], depth[hit] + 0.25)
    assert not bool(moved[~hit].any())
    gone = depth_of(faulty(view, f"depth-offset:{-float(depth[hit].median())}", 0))
    assert 0.4 < float((gone[hit] == 0).float().mean()) < 0.6  # no depth is behind the camera


@pytest.mark.parametrize(("fault", "power"), [("depth-noise", 1), ("depth-noise-squared", 2)])
def test_noise_grows_with_distance(fault: str, power: int) -> None:
    for metres in (1.0, 4.0):
        error = depth_of(faulty(plain(metres), f"{fault}:0.01", 0)) - metres
        deviation = 0.01 * metres**power
        n = error.numel()
        assert abs(float(error.mean())) < 4 * deviation / math.sqrt(n)
        assert float(error.std()) == pytest.approx(deviation, rel=4 / math.sqrt(2 * n))


def test_steps_are_multiples(view: View) -> None:
    depth, rounded = depth_of(view), depth_of(faulty(view, "depth-steps:0.25", 0))
    assert torch.equal(rounded, (rounded * 4).round() / 4)
    assert float((rounded - depth).abs().max()) <= 0.125 + 1e-6
    assert 2 < len(rounded.unique()) < 20


def test_holes_have_their_share_and_shape(view: View) -> None:
    full = plain(3.0)
    n = depth_of(full).numel()
    for share in (0.25, 0.9):
        missing = float((depth_of(faulty(full, f"depth-holes:{share}", 0)) == 0).float().mean())
        assert missing == pytest.approx(share, abs=4 * math.sqrt(share * (1 - share) / n))
        hole = depth_of(faulty(full, f"depth-hole:{share}", 0)) == 0
        assert float(hole.float().mean()) == pytest.approx(share, abs=0.02)  # pixels in a row along the line
        assert label(hole.numpy())[1] == label(~hole.numpy())[1] == 1
    hit = depth_of(view) > 0
    left = depth_of(faulty(view, "depth-hole:0.5", 1)) > 0
    assert float(left.sum() / hit.sum()) == pytest.approx(0.5, abs=0.03)
    assert not bool(depth_of(faulty(full, "depth-hole:1", 0)).any())


def test_misregistered_depth_is_moved_by_its_size() -> None:
    centres = CAMERA.pixel_centres()
    for seed in range(4):
        moves = []
        for axis in (0, 1):
            ramp = View(dataclasses.replace(plain().frame, depth=100 + centres[..., axis]), SE3.identity())
            after = depth_of(faulty(ramp, "depth-shift:6.5", seed))
            inside = after > 0
            assert 0.7 < float(inside.float().mean()) < 1
            moves.append(float((100 + centres[..., axis] - after)[inside].mean()))
        assert math.hypot(*moves) == pytest.approx(6.5, abs=0.75)  # each axis is rounded to whole pixels


@pytest.mark.parametrize(
    ("fault", "height", "width"), [("depth-window:25", 25, 25), ("depth-rows:3", 3, 80), ("depth-window:70", 60, 70)]
)
def test_only_a_window_or_rows_remain(fault: str, height: int, width: int) -> None:
    for seed in range(5):
        mask = depth_of(faulty(plain(3.0), fault, seed)) > 0
        assert (int(mask.any(1).sum()), int(mask.any(0).sum()), int(mask.sum())) == (height, width, height * width)


def test_only_the_largest_plane_remains() -> None:
    """Two planes meet at an edge, the larger of them oblique."""
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    oblique = 3.0 / (1 + 0.5 * rays[..., 0])  # x / 2 + z = 3
    larger = CAMERA.pixel_centres()[..., 0] > 25
    depth = torch.where(larger, oblique, torch.full_like(oblique, 9.0))
    frame = dataclasses.replace(plain().frame, depth=depth)
    for seed in range(3):
        kept = depth_of(faulty(View(frame, SE3.identity()), "depth-wall", seed))
        assert torch.equal(kept > 0, larger)


# The camera.


@pytest.mark.parametrize(
    ("fault", "factors"),
    [("focal:1.05", (1.05, 1.05)), ("stretch:1.1", (1.1, 1.0)), ("principal-point:10", (1.0, 1.0))],
)
def test_wrong_intrinsics_leave_the_image_alone(fault: str, factors: tuple[float, float], view: View) -> None:
    own = view.frame.intrinsics
    for seed in range(3):
        frame = faulty(view, fault, seed).frame
        assert frame.rgb_bytes is view.frame.rgb_bytes
        camera = frame.intrinsics
        assert (camera.fx, camera.fy) == (own.fx * factors[0], own.fy * factors[1])
        moved = 10 if fault.startswith("principal") else 0
        assert math.hypot(camera.cx - own.cx, camera.cy - own.cy) == pytest.approx(moved)
        assert dataclasses.replace(camera, fx=own.fx, fy=own.fy, cx=own.cx, cy=own.cy) == own


@pytest.mark.parametrize("fault", ["focal:0.5+nominal", "nominal+focal:0.5"])
def test_a_nominal_camera_has_only_a_focal_length(fault: str, view: View) -> None:
    own, frame = view.frame.intrinsics, faulty(view, fault, 0).frame
    assert frame.rgb_bytes is view.frame.rgb_bytes
    assert frame.focal_is_approximate
    assert frame.intrinsics.fx == pytest.approx(0.5 * math.sqrt(own.fx * own.fy))
    assert frame.intrinsics == Intrinsics.from_focal(frame.intrinsics.fx, own.width, own.height)


def test_a_crop_keeps_a_corner_and_the_offset_of_the_principal_point(view: View) -> None:
    own, width, height = view.frame.intrinsics, round(0.75 * LENS.width), round(0.75 * LENS.height)
    corners = [(y, x) for y in (0, own.height - height) for x in (0, own.width - width)]
    parts = [view.frame.rgb[y : y + height, x : x + width] for y, x in corners]
    for seed in range(3):
        frame = faulty(view, "crop:0.25", seed).frame
        assert any(torch.equal(frame.rgb, part) for part in parts)
        offset = frame.intrinsics.cx - width / 2, frame.intrinsics.cy - height / 2
        assert offset == (own.cx - own.width / 2, own.cy - own.height / 2)
    smallest = plain(camera=Intrinsics(1.0, 1.0, 0.5, 0.5, 2, 1))
    assert faulty(smallest, "crop:0.9", 0).frame.rgb.shape == (1, 1, 3)


@pytest.mark.parametrize("k1", [0.3, -0.1])
def test_distortion_is_that_of_opencv(k1: float) -> None:
    """Each pixel shows what OpenCV says that an undistorted camera shows there."""
    centres, size = CAMERA.pixel_centres(), torch.tensor([CAMERA.width, CAMERA.height])
    assert faulty(plain(), f"distortion:{k1}", 0).frame.intrinsics == CAMERA
    matrix = CAMERA.matrix().numpy()
    expected = cv2.undistortPoints(
        centres.reshape(-1, 1, 2).double().numpy(), matrix, np.array([k1, 0, 0, 0]), P=matrix
    )
    low, high = np.array([0.5, 0.5]), size.numpy() - 0.5  # beyond the outermost centres colours do not change
    found = places(f"distortion:{k1}", 0).reshape(-1, 2).numpy()
    assert np.abs(found - expected[:, 0].clip(low, high)).max() < 0.02
    assert np.abs(found - centres.reshape(-1, 2).numpy()).max() > 1


def test_a_rolling_shutter_sees_what_a_turning_camera_would() -> None:
    """Each row is compared with that row of an image rendered at the row's own pose."""
    scene, pose = demo_room(), INSIDE
    (still,) = seen_from(scene, CAMERA, [pose])
    rolled = rolling_shutter(still.frame, 8.0, torch.Generator().manual_seed(1))
    axis = random_units(1, torch.Generator().manual_seed(1))[0] * math.radians(8.0)
    sample = torch.arange(0, CAMERA.height, 7)
    moments = (sample.double() + 0.5) / CAMERA.height - 0.5
    turned = [pose @ SE3.exp(torch.cat([torch.zeros(3, dtype=torch.float64), m * axis])) for m in moments]
    frames = [v.frame for v in seen_from(scene, CAMERA, turned)]
    inside = depth_of(View(rolled, pose))[sample] > 0
    assert float(inside.float().mean()) > 0.8
    for what in ("rgb", "depth"):
        truth = torch.stack([getattr(f, what)[row] for row, f in zip(sample.tolist(), frames, strict=True)])
        error, without = ((getattr(f, what)[sample] - truth)[inside].abs().mean() for f in (rolled, still.frame))
        assert float(error) < 0.25 * float(without)


# Colour.


def test_exposure_and_white_balance_multiply(view: View) -> None:
    rgb = view.frame.rgb
    for fault, factor in (
        ("exposure:0.7", 0.7),
        ("exposure:2", 2.0),
        ("white-balance:1.25", torch.tensor([1.25, 1, 0.8])),
    ):
        expected = (rgb * factor).clamp(max=1)
        torch.testing.assert_close(faulty(view, fault, 0).frame.rgb, expected, atol=BYTE / 2, rtol=0)
    assert faulty(view, "exposure:2", 0).frame.depth is view.frame.depth


def test_blur_has_its_standard_deviation() -> None:
    edge = torch.zeros(60, 80, 3)
    edge[:, 40:] = 1.0
    view = View(plain().frame.replace(rgb=edge), SE3.identity())
    for pixels in (1.0, 3.0):
        weights = faulty(view, f"blur:{pixels}", 0).frame.rgb[30, :, 0].double().diff()
        offsets = torch.arange(1, 80) - 40
        assert float(weights.sum()) == pytest.approx(1)
        variance = float((weights * offsets.square()).sum())
        assert math.sqrt(variance) == pytest.approx(pixels, rel=0.03)  # the kernel ends at three deviations
    assert torch.allclose(faulty(plain(), "blur:1000", 0).frame.rgb, plain().frame.rgb)  # wider than the image


def test_jpeg_loses_more_at_a_lower_quality(view: View) -> None:
    errors = [float((faulty(view, f"jpeg:{q}", 0).frame.rgb - view.frame.rgb).square().mean()) for q in (95, 50, 5)]
    assert errors[0] < errors[1] < errors[2] < 0.05


def test_grey_has_one_value(view: View) -> None:
    grey = faulty(view, "grey:1", 0).frame.rgb
    assert torch.allclose(grey[..., :1].expand_as(grey), grey, atol=1e-6)
    half = faulty(view, "grey:0.5", 0).frame.rgb
    torch.testing.assert_close(half, (grey + view.frame.rgb) / 2, atol=0.75 * BYTE, rtol=0)  # grey is rounded, too


def test_vignetting_darkens_corners() -> None:
    rgb = faulty(plain(rgb=0.8), "vignetting:0.6", 0).frame.rgb
    assert float(rgb[29:31, 39:41].min()) == pytest.approx(0.8, rel=0.01)
    assert float(rgb[0, 0, 0]) == pytest.approx(0.8 * 0.4, rel=0.05)
    assert all(torch.allclose(rgb, rgb.flip([axis])) for axis in (0, 1))


# The scene.


@pytest.mark.parametrize("seed", range(4))
def test_an_occluder_is_one_piece_in_front(seed: int, view: View) -> None:
    before = depth_of(view)
    masks = []
    for share in (0.1, 0.25, 0.5):
        hidden = faulty(view, f"occluder:{share}", seed)
        mask = (hidden.frame.rgb != view.frame.rgb).any(-1)
        assert float(mask.float().mean()) == pytest.approx(share, abs=0.01)  # a colour may coincide
        filled = depth_of(hidden) != before
        assert float(filled.float().mean()) == pytest.approx(share, abs=1e-3)
        assert label(filled.numpy())[1] == 1
        assert float(depth_of(hidden)[filled].max()) < float(before[before > 0].min())
        assert bool((alpha_of(hidden)[filled] == 1).all())
        blind = faulty(view, f"occluder-unmeasured:{share}", seed)
        assert bool((depth_of(blind) <= before).all())
        gone = (blind.frame.rgb != view.frame.rgb).any(-1)
        assert not bool(depth_of(blind)[gone].any())
        assert torch.equal(
            depth_of(blind)[~gone & (before > 0)] > 0, torch.ones(int((~gone & (before > 0)).sum()), dtype=torch.bool)
        )
        masks.append(filled)
    assert not bool((masks[0] & ~masks[1]).any() or (masks[1] & ~masks[2]).any())  # larger ones cover smaller ones


def test_a_moved_thing_is_a_copy_from_elsewhere() -> None:
    view, centres = plain(), CAMERA.pixel_centres()
    for seed in range(3):
        moved = faulty(view, "moved:0.2", seed)
        copied = depth_of(moved) != depth_of(view)
        assert float(copied.float().mean()) == pytest.approx(0.2, abs=1e-3)
        assert torch.equal(moved.frame.rgb[~copied], view.frame.rgb[~copied])
        (depth,) = depth_of(moved)[copied].unique().tolist()
        assert 0.85 <= depth / 2.0 <= 0.98
        moves = (centres - places("moved:0.2", seed))[copied]
        move = moves.median(dim=0).values
        assert 0.15 * 60 - 0.1 <= float(move.norm()) <= 0.3 * 60 + 0.1
        assert float(((moves - move).norm(dim=-1) < 0.05).float().mean()) > 0.5  # the rest is mirrored at a border


def test_things_are_added_and_vanish_in_one_piece_of_the_surface(view: View) -> None:
    before, hit = depth_of(view), depth_of(view) > 0
    added = faulty(view, "added:0.2", 0)
    nearer = depth_of(added) < before
    assert float(nearer.sum() / hit.sum()) == pytest.approx(0.2, abs=0.005)
    assert torch.equal(depth_of(added)[~nearer], before[~nearer])
    assert torch.equal(added.frame.rgb[~nearer], view.frame.rgb[~nearer])
    assert float((depth_of(added) / before)[nearer].min()) > 0.8
    gone = faulty(view, "vanished:0.2", 0)
    lost = hit & (depth_of(gone) == 0)
    assert float(lost.sum() / hit.sum()) == pytest.approx(0.2, abs=0.005)
    background = torch.tensor(demo_object().bounds.background)
    assert torch.allclose(gone.frame.rgb[lost], background.expand(int(lost.sum()), 3))
    assert not bool(alpha_of(gone)[lost].any())


def test_what_vanishes_in_a_room_uncovers_what_is_around_and_behind() -> None:
    (room,) = seen_from(demo_room(), CAMERA, [INSIDE])
    gone = faulty(room, "vanished:0.2", 0)
    changed = (gone.frame.rgb - room.frame.rgb).abs().amax(-1) > 1 / 255
    farther = depth_of(gone) > depth_of(room)
    assert 0.05 < float(farther.float().mean()) <= 0.21
    assert len(depth_of(gone)[farther].unique()) == 1
    assert 0.02 < float(changed.float().mean()) <= 0.21


# The whole image.


@pytest.mark.parametrize(("fault", "axis"), [("mirror", 1), ("flip", 0)])
def test_mirrored_images(fault: str, axis: int, view: View) -> None:
    mirrored = faulty(view, fault, 0)
    assert torch.equal(mirrored.frame.rgb, view.frame.rgb.flip(axis))
    assert torch.equal(depth_of(mirrored), depth_of(view).flip(axis))
    assert same(faulty(mirrored, fault, 0).frame, view.frame)


def test_an_image_upside_down_shows_the_same_points_from_its_own_pose(view: View) -> None:
    turned = faulty(view, "upside-down", 0)
    points = [
        v.T_ref_camera.apply(
            (
                v.frame.intrinsics.unproject(v.frame.intrinsics.pixel_centres(torch.float64)) * depth_of(v)[..., None]
            ).double()
        )
        for v in (view, turned)
    ]
    torch.testing.assert_close(points[1].flip([0, 1]), points[0], rtol=0, atol=1e-5)
    assert torch.equal(turned.frame.rgb.flip([0, 1]), view.frame.rgb)


def test_a_covered_lens_shows_one_colour_and_measures_nothing(view: View) -> None:
    covered = faulty(view, "covered", 0)
    assert len(covered.frame.rgb.flatten(0, 1).unique(dim=0)) == 1
    assert not bool(depth_of(covered).any())


@pytest.mark.usefixtures("unchecked")
def test_a_fault_that_returns_no_frame_is_named(view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = dataclasses.replace(FAULTS["blur"], change=lambda frame, size, generator: None)  # type: ignore[arg-type, return-value]
    monkeypatch.setattr("bidnerf_core.registry.registered", {("faults", "nothing"): nothing})
    with refused(where="fault nothing:2", found="returned a NoneType", expected="a Frame"):
        faulty(view, "nothing:2", seed=0)
