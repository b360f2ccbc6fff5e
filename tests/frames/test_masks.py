"""Masks: what they hide is read right from every convention, and then influences nothing."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from bidnerf import Frame, InputError, InputWarning, Intrinsics, View, open_dataset, open_sequence
from bidnerf.scenes import demo_object
from bidnerf_bid import DRAWERS, DrawerName
from bidnerf_core.camera import Orientation, Raster
from bidnerf_core.carving import FreeSpace
from bidnerf_core.fields import RenderedImage
from bidnerf_core.frames import MaskFolder, Thumbnail, WhollyHidden, averaged, is_blank, masks_sentence, read_mask
from bidnerf_core.mapping import SIFT, image_keypoints, track_views
from bidnerf_core.maps import rendering_scores

# Inside: each quantity computed from pixels, which is equal whatever a mask hides
from bidnerf_core.training import RayBank, photo_measures
from commands import Run
from optional import require
from photo_files import write_photo
from refusals import refused
from tiny import options, views, write_dataset

SIZE = (12, 8)  # width, height


def left(width: int = SIZE[0], height: int = SIZE[1], share: float = 0.25) -> np.ndarray:
    """A mask in which the left part is black, the rest white."""
    mask = np.full((height, width), 255, np.uint8)
    mask[:, : int(width * share)] = 0
    return mask


def saved(path: Path, mask: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(path, mask)
    return path


@pytest.mark.parametrize(
    "stored",
    [
        left(),
        left() // 255,
        left() == 255,
        left().astype(np.uint16) * 257,
        np.dstack([left()] * 3),
        np.dstack([np.full((*SIZE[::-1], 3), 200, np.uint8), left()]),  # as the alpha channel of one colour
        left(24, 16),
        left(6 * 4, 4 * 4),
    ],
)
def test_masks_of_every_kind_hide_what_is_black(tmp_path: Path, stored: np.ndarray) -> None:
    path = saved(tmp_path / "mask.png", stored)
    hidden = read_mask(path, Raster(*SIZE), SIZE)
    assert torch.equal(hidden, torch.from_numpy(left() == 0))
    assert torch.equal(read_mask(path, Raster(*SIZE), SIZE, "white"), ~hidden)


@pytest.mark.parametrize(
    ("mask", "error", "found", "expected"),
    [
        (left() * 0, WhollyHidden, "inverted", None),
        (left(30, 8), InputError, "mask is 30x8, but its image is 12x8", "the same aspect ratio"),
        (None, InputError, "is in none of the formats", "a complete image file"),
    ],
    ids=["black", "wide", "text"],
)
def test_unusable_masks_are_refused(
    tmp_path: Path, mask: np.ndarray | None, error: type[InputError], found: str, expected: str | None
) -> None:
    path = tmp_path / "mask.png"
    path.write_text("no image") if mask is None else saved(path, mask)
    with refused(where=path, found=found, expected=expected, error=error):
        read_mask(path, Raster(*SIZE), SIZE)


@pytest.mark.parametrize("name", ["a.png", "a.jpg.png", "a_mask.png", "dynamic_mask_a.png", "cam/a.png", "a.mask.jpg"])
def test_masks_are_found_by_the_name_of_their_photo(tmp_path: Path, name: str) -> None:
    path = saved(tmp_path / name, left())
    saved(tmp_path / "other.png", left())
    assert MaskFolder(tmp_path).file_of("a") == path
    assert MaskFolder(tmp_path).file_of("b") is None


def test_folders_of_masks_without_masks_are_refused(tmp_path: Path) -> None:
    with refused(where=tmp_path / "none", found="no such folder", expected="a folder of masks"):
        MaskFolder(tmp_path / "none")
    with refused(where=tmp_path, found="contains no images", expected="masks"):
        MaskFolder(tmp_path)
    saved(tmp_path / "a" / "1.png", left())
    saved(tmp_path / "b" / "1.png", left())
    masks = MaskFolder(tmp_path)
    assert masks.file_of("a_1") == tmp_path / "a" / "1.png"
    with refused(found="both match 1", expected="one mask"):
        masks.file_of("1")
    with refused(where=tmp_path, found="no mask in it", expected="x.png"):
        masks.require_any(["x", "y"])
    with refused(found="mask_hides is 'grey'", expected="one of black, white"):
        MaskFolder(tmp_path, "grey")  # type: ignore[arg-type]


def test_inverted_masks_are_suspected() -> None:
    part = torch.from_numpy(left() == 0)
    assert masks_sentence([None, None]) is None
    usual, inverted = masks_sentence([part, None]), masks_sentence([~part, ~part, None])
    assert usual == "masks hide 25 % of the pixels of 1 image; 1 image without hidden pixels"
    assert "inverted" in require(inverted)


def masked_dataset(folder: Path, **keys: str) -> Path:
    """A dataset in whose description every frame also has ``keys``, of which ``{}`` is its name."""
    path = write_dataset(folder, train=3, test=1, depth=False) / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        frame |= {key: value.format(Path(frame["file_path"]).stem) for key, value in keys.items()}
    path.write_text(json.dumps(content))
    return folder


def test_mask_path_and_dynamic_masks_are_read(tmp_path: Path) -> None:
    data = masked_dataset(tmp_path, mask_path="masks/{}.png")
    with refused(found="no such mask"):
        open_dataset(data)
    names = [f"r_{number:04d}" for number in range(3)]
    for name in names[:2]:
        saved(data / "masks" / f"{name}.png", left(48, 48))
    with pytest.warns(InputWarning, match="2 of 4 masks are missing"):
        first, _, third = open_dataset(data).views("train")
    assert torch.equal(require(first.frame.hidden), torch.from_numpy(left(24, 24) == 0))
    assert third.frame.hidden is None
    saved(data / "images" / f"dynamic_mask_{names[0]}.png", left(24, 24))
    with pytest.warns(InputWarning):
        opened = open_dataset(data)
    with refused(error=WhollyHidden):  # the one hides the left, the other the rest
        opened.views("train", names[:1])
    assert [view.frame.name for view in opened.views("train")] == names[1:]
    assert opened.hidden_frames("train") == []  # neither mask hides everything by itself
    saved(data / "masks" / f"{names[1]}.png", np.zeros((48, 48), np.uint8))
    assert opened.hidden_frames("train") == names[1:2]
    assert opened.hidden_frames("all") == names[1:2]
    assert names[1] not in [view.frame.name for view in opened.views("all")]


def test_a_folder_of_masks_serves_datasets_and_sequences(tmp_path: Path) -> None:
    data = masked_dataset(tmp_path / "data")
    names = open_dataset(data).frame_names("train")
    saved(tmp_path / "masks" / f"{names[1]}.png", left(24, 24))
    read = open_dataset(data, masks=tmp_path / "masks").views("train")
    assert [view.frame.hidden is not None for view in read] == [False, True, False]
    timed = {f.frame.name: f.frame.hidden for f in open_sequence(data, masks=tmp_path / "masks")}
    assert [name for name, hidden in timed.items() if hidden is not None] == [names[1]]
    saved(tmp_path / "others" / "zebra.png", left(24, 24))
    with refused(where=tmp_path / "others", found="no mask in it", expected=f"{names[0]}.png"):
        open_dataset(data, masks=tmp_path / "others")


@pytest.mark.parametrize("code", range(1, 9))
@pytest.mark.parametrize("size", [SIZE, (8, 8)])
def test_masks_of_turned_photos_serve_sequences_as_they_serve_photos(
    tmp_path: Path, code: int, size: tuple[int, int]
) -> None:
    photo = write_photo(tmp_path / "photos" / "p.png", np.zeros((*size[::-1], 3), np.uint8), code)
    mask = left(*size)
    mask[0] = 0
    path = saved(tmp_path / "masks" / "p.png", mask)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        alone = require(Frame.open(photo, focal=10.0, mask=path).hidden)
        (timed,) = open_sequence(tmp_path / "photos", focal=10.0, masks=tmp_path / "masks")
        upright = Frame.open(photo, focal=10.0).rgb.shape[:2]
    assert torch.equal(alone, Orientation.from_exif(code).upright(torch.from_numpy(mask == 0)))
    assert torch.equal(require(timed.frame.hidden), alone)
    assert alone.shape == upright


def test_frames_take_masks_as_arrays() -> None:
    rgb, camera = np.zeros((SIZE[1], SIZE[0], 3), np.uint8), Intrinsics.from_focal(10.0, *SIZE)
    made = Frame.from_numpy(rgb, camera, hidden=left() == 0)
    assert torch.equal(require(made.hidden), torch.from_numpy(left() == 0))
    assert Frame.from_numpy(rgb, camera, hidden=left() < 0).hidden is None
    for nothing in (None, torch.from_numpy(left() < 0)):
        assert made.with_hidden(nothing) is made


def hiding(view: View, content: torch.Tensor) -> View:
    """The view with ``content`` (h w 3) in its hidden left half, where alpha and depth change as well."""
    frame = view.frame
    hidden = torch.zeros(frame.rgb.shape[:2], dtype=torch.bool)
    hidden[:, : frame.intrinsics.width // 2] = True
    rgb = torch.where(hidden[..., None], content, frame.rgb)
    alpha = None if frame.alpha is None else torch.where(hidden, content[..., 0].round(), frame.alpha)
    return replace(view, frame=replace(frame, rgb=rgb, alpha=alpha, hidden=hidden))


def drawn(view: View, name: DrawerName) -> torch.Tensor:
    pixels = DRAWERS[name](view.frame, 300, torch.Generator().manual_seed(0))
    return view.frame.rgb[pixels[:, 1], pixels[:, 0]]


def scored(view: View) -> torch.Tensor:
    grey = torch.full_like(view.frame.rgb, 0.5)
    image = RenderedImage(grey, grey[..., 0], grey[..., 0])
    return torch.tensor(rendering_scores(image, view.frame).psnr)


INFLUENCED: dict[str, Callable[[View], torch.Tensor]] = {
    "rays": lambda view: drawn(view, "uniform"),
    "training rays": lambda view: (
        RayBank([view], demo_object().bounds).draw(2000, torch.Generator().manual_seed(0)).observed.rgb
    ),
    "free space": lambda view: FreeSpace.seen_by(view).levels[0],
    "scores": scored,
    "measures": lambda view: photo_measures([view])[1:],
    "thumbnail": lambda view: Thumbnail.of(view, 12).rgb,
    "blurred colours": lambda view: averaged(view.frame, 4)[:, 13:],
    "blankness": lambda view: torch.tensor(is_blank(view.frame)),
}


@pytest.mark.parametrize("what", list(INFLUENCED))
def test_what_is_hidden_changes_nothing(what: str) -> None:
    (view,) = views(1)
    generator = torch.Generator().manual_seed(0)
    one, two = (hiding(view, torch.rand(view.frame.rgb.shape, generator=generator)) for _ in range(2))
    assert torch.equal(INFLUENCED[what](one), INFLUENCED[what](two))
    uncovered = (replace(v, frame=replace(v.frame, hidden=None)) for v in (one, two))
    if what != "blankness":
        assert not torch.equal(*map(INFLUENCED[what], uncovered))  # it would, were it not hidden


def test_one_visible_pixel_is_enough_for_rays() -> None:
    (view,) = views(1)
    hidden = torch.ones(view.frame.rgb.shape[:2], dtype=torch.bool)
    hidden[7, 3] = False
    bank = RayBank([replace(view, frame=replace(view.frame, alpha=None, hidden=hidden))], demo_object().bounds)
    drawn = bank.draw(50, torch.Generator().manual_seed(0)).observed
    assert torch.equal(drawn.rgb, view.frame.rgb[7, 3].expand(50, 3))


def test_no_keypoint_reaches_into_what_is_hidden() -> None:
    coarse = torch.rand(1, 3, 30, 40, generator=torch.Generator().manual_seed(0))
    rgb = torch.nn.functional.interpolate(coarse, (120, 160), mode="bicubic")[0].movedim(0, -1).clamp(0, 1)
    (like,) = views(1)
    camera = replace(like.frame.intrinsics, width=160, height=120, cx=80.0, cy=60.0)
    hidden = torch.zeros(120, 160, dtype=torch.bool)
    hidden[30:90, 40:120] = True
    view = View(Frame("noise", rgb, camera, hidden=hidden), like.T_ref_camera)
    whole = replace(view, frame=replace(view.frame, hidden=None))
    of_map = track_views([view], SIFT).observations.images[0].keypoints
    of_query = image_keypoints(view, SIFT).keypoints
    for keypoints in (of_map, of_query):
        assert 20 < len(keypoints) < 0.8 * len(image_keypoints(whole, SIFT).keypoints)
        u, v = keypoints.pixels.unbind(-1)
        reach = keypoints.sizes / 2 - 1
        inside = (u + reach > 40) & (u - reach < 120) & (v > 30) & (v < 90)
        assert not bool(inside.any())


def test_training_says_what_is_hidden(tmp_path: Path, bidnerf: Run) -> None:
    data, masks, out = masked_dataset(tmp_path / "data"), tmp_path / "masks", tmp_path / "map"
    first, second, third = open_dataset(data).frame_names("train")
    saved(masks / f"{first}.png", left(24, 24))
    saved(masks / f"{third}.png", 0 * left(24, 24))
    words = ("train", data, "--out", out, "--masks", masks, "--refine-poses", "never")
    done = bidnerf(*words, *options()).succeed()
    assert "1 image left out, being entirely hidden" in done.err
    assert "masks hide 25 % of the pixels of 1 image; 1 image without hidden pixels" in done.err
    failed = bidnerf("train", data, "--out", tmp_path / "m2", "--mask-hides", "white", *options())
    assert (failed.status, "without --masks" in failed.err) == (2, True)
    for name in (first, second):
        saved(masks / f"{name}.png", 0 * left(24, 24))
    failed = bidnerf("train", data, "--out", tmp_path / "m3", "--masks", masks, *options())
    assert (failed.status, "masks hide every image" in failed.err) == (1, True)
