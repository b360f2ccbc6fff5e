r"""The problems that a capture's record reports when the photos and poses of a dataset are damaged in known ways.

    python benchmarks/capture_report.py DATA [DATA ...] [--name capture_report]

Each case combines kinds of damage that do not interfere, on photos that are drawn with a fixed seed:

- none, to see what is reported for the photos as they are;
- ten photos removed on one side, five blurred by a moving camera, one wrong pose;
- a tenth of the poses wrong, one photo upside down, one mirrored, five photos four stops too dark or too bright;
- photos of two places in one folder (each dataset with the next one of the command);
- photos from one place; two photos.

Recorded are the photos for which each problem was reported, rightly or not, and precision and recall. The photos of the case
without damage are real: what is reported for them already is listed separately, since it may be right.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import _lab
import cv2
import numpy as np
import torch
from torch import Generator, Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import CaptureReport, Gap, horizontal_axes, summary, surveyed
from bidnerf_core.datasets import open_dataset
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import SIFT, Features, FoundOnce, tracked_views

BLUR = 0.02
"""Length of the motion blur, as a share of the image's longer side."""
TURN, SHIFT = 15.0, 0.3
"""A wrong pose: degrees, and share of the distance between the cameras' mean and the camera."""
STOPS = 4.0


@dataclass
class Case:
    """A damaged capture, and its true problems."""

    views: list[View]
    truth: dict[str, set[str]] = field(default_factory=dict)  # names of photos by problem
    gap: Gap | None = None
    arrangement: str | None = None


def drawn(views: Sequence[View], count: int, generator: Generator, among: Sequence[int] | None = None) -> list[int]:
    """Return the numbers of ``count`` photos, drawn without replacement."""
    left = torch.tensor(range(len(views)) if among is None else among)
    return left[torch.randperm(len(left), generator=generator)[:count]].tolist()


def blurred(view: View, generator: Generator) -> View:
    """Return the photo blurred along a line of random direction, in linear light."""
    image = view.frame.rgb.numpy()
    length = max(3, round(BLUR * max(image.shape)))
    angle = float(torch.rand((), generator=generator)) * math.pi
    kernel = np.zeros((2 * length + 1, 2 * length + 1), np.float32)
    end = (0.5 * length * np.array([math.cos(angle), math.sin(angle)])).round().astype(int)
    cv2.line(kernel, tuple((length - end).tolist()), tuple((length + end).tolist()), 1.0)
    light = cv2.filter2D(image**2.2, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)
    return with_image(view, light.clip(0, 1) ** (1 / 2.2))


def exposed(view: View, stops: float) -> View:
    """Return the photo as if taken with ``stops`` stops more light, and stored in 8 bits."""
    image = view.frame.rgb.numpy() * 2 ** (stops / 2.2)
    return with_image(view, (image.clip(0, 1) * 255).round() / 255)


def with_image(view: View, image: np.ndarray) -> View:
    rgb = torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32))
    return replace(view, frame=replace(view.frame, rgb=rgb))


def misplaced(view: View, middle: Tensor, generator: Generator) -> View:
    """Return the photo with a pose that is turned and shifted in random directions."""
    directions = torch.nn.functional.normalize(torch.randn((2, 3), generator=generator, dtype=torch.float64), dim=-1)
    T = view.T_ref_camera.to("cpu", torch.float64)
    size = SHIFT * torch.linalg.vector_norm(T.translation - middle)
    return replace(
        view, T_ref_camera=T @ SE3.exp(torch.cat([size * directions[0], math.radians(TURN) * directions[1]]))
    )


def names(views: Sequence[View], numbers: Sequence[int]) -> set[str]:
    return {views[i].frame.name for i in numbers}


def side_blur_and_pose(views: list[View], report: CaptureReport, generator: Generator) -> Case:
    """Remove ten photos on one side, blur five, and change one pose."""
    order = _around(report)
    first = 1 + int(torch.randint(len(order) - 12, (), generator=generator))
    removed = order[first : first + 10]
    left = [i for i in range(len(views)) if i not in removed]
    chosen = drawn(views, 6, generator, left)
    changed, middle = list(views), _middle(views)
    for i in chosen[:5]:
        changed[i] = blurred(views[i], generator)
    changed[chosen[5]] = misplaced(views[chosen[5]], middle, generator)
    truth = {"blurred": names(views, chosen[:5]), "badly posed": names(views, chosen[5:])}
    ends = views[order[first - 1]].frame.name, views[order[first + 10]].frame.name
    return Case([changed[i] for i in left], truth, Gap(0.0, *ends))


def poses_turns_and_exposure(views: list[View], report: CaptureReport, generator: Generator) -> Case:
    """Change a tenth of the poses, turn one photo upside down, mirror one, and expose five by four stops more or less."""
    wrong = round(len(views) / 10)
    chosen = drawn(views, wrong + 7, generator)
    changed, middle = list(views), _middle(views)
    for i in chosen[:wrong]:
        changed[i] = misplaced(views[i], middle, generator)
    turned, mirrored, *jumps = chosen[wrong:]
    changed[turned] = with_image(views[turned], views[turned].frame.rgb.flip(0, 1).numpy())
    changed[mirrored] = with_image(views[mirrored], views[mirrored].frame.rgb.flip(1).numpy())
    for place, i in enumerate(jumps):
        changed[i] = exposed(views[i], STOPS if place % 2 else -STOPS)
    truth = {
        "badly posed": names(views, chosen[:wrong]),
        "turned": names(views, [turned]),
        "mirrored": names(views, [mirrored]),
        "badly exposed": names(views, jumps),
    }
    return Case(changed, truth)


def two_places(views: list[View], others: list[View]) -> Case:
    """Join half of a capture with a quarter of another one, moved so that the cameras of both are in one place."""
    shift = SE3(torch.eye(3, dtype=torch.float64), _middle(views) - _middle(others))
    strangers = [
        View(v.frame.replace(name=f"other {v.frame.name}"), shift @ v.T_ref_camera.to("cpu", torch.float64))
        for v in others[::4]
    ]
    return Case([*views[::2], *strangers], {"apart": {v.frame.name for v in strangers}})


def one_place(views: list[View], generator: Generator) -> Case:
    """Return twelve photos, cut from a real one, that a camera at one place would take, turned by up to ten degrees."""
    source = views[drawn(views, 1, generator)[0]]
    given = source.frame.intrinsics
    width, height = round(0.6 * given.width), round(0.6 * given.height)
    camera = Intrinsics(given.fx, given.fy, width / 2, height / 2, width, height)
    made = []
    for number in range(12):
        turn = torch.zeros(6, dtype=torch.float64)
        turn[3:5] = math.radians(20) * (torch.rand(2, generator=generator, dtype=torch.float64) - 0.5)
        T = SE3.exp(turn)
        pixels = _pixel_grid(camera)
        where = given.project(T.apply(camera.unproject(pixels))).float().numpy() - 0.5
        x, y = where[:, 0].reshape(height, width), where[:, 1].reshape(height, width)
        image = cv2.remap(source.frame.rgb.numpy(), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        frame = replace(
            source.frame,
            name=f"turn {number}",
            rgb=torch.from_numpy(image),
            intrinsics=camera,
            depth=None,
            alpha=None,
        )
        made.append(View(frame, source.T_ref_camera.to("cpu", torch.float64) @ T))
    return Case(made, arrangement="one place")


def _pixel_grid(camera: Intrinsics) -> Tensor:
    v, u = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    return torch.stack([u, v], dim=-1).reshape(-1, 2).double() + 0.5


def _middle(views: Sequence[View]) -> Tensor:
    return torch.stack([v.T_ref_camera.translation.double() for v in views]).mean(0)


def _around(report: CaptureReport) -> list[int]:
    """Return the numbers of the photos in their order around the scene, beginning after its widest gap."""
    up, centre = (torch.tensor(v, dtype=torch.float64) for v in (report.coverage.up, report.coverage.centre))
    away = torch.tensor([photo.position for photo in report.photos], dtype=torch.float64) - centre
    first, second = horizontal_axes(up)
    azimuth = torch.atan2(away @ second, away @ first)
    order = azimuth.argsort()
    steps = torch.diff(azimuth[order], append=azimuth[order[:1]] + 2 * math.pi)
    return order.roll(-1 - int(steps.argmax())).tolist()


def judged(case: Case, report: CaptureReport, usual: dict[str, set[str]]) -> dict[str, Any]:
    """Compare what the record reports with the truth; ``usual`` is what it reports without damage."""
    problems = {}
    for problem in sorted(set(case.truth) | {p for photo in report.photos for p in photo.problems}):
        named = {photo.name for photo in report.with_problem(problem)}  # type: ignore[arg-type]
        truth = case.truth.get(problem, set())
        false = named - truth
        new = false - usual.get(problem, set())
        right = len(named & truth)
        problems[problem] = {
            "damaged": len(truth),
            "named": len(named),
            "right": right,
            "missed": sorted(truth - named),
            "named_without_damage_too": sorted(false - new),
            "false": sorted(new),
            "recall": right / len(truth) if truth else None,
            "precision": right / (right + len(new)) if right + len(new) else None,
        }
    found: dict[str, Any] = {"photos": len(report.photos), "problems": problems, "summary": summary(report)}
    if case.gap is not None:
        ends = {case.gap.after, case.gap.before}
        gaps = [(gap.degrees, gap.after, gap.before) for gap in report.coverage.gaps]
        found |= {
            "gap_made": sorted(ends),
            "gaps_named": gaps,
            "gap_found": any(ends == set(g[1:]) for g in gaps),
        }
    if case.arrangement is not None:
        found["arrangement_found"] = report.coverage.arrangement == case.arrangement
    return found


def survey(views: list[View], features: Features) -> tuple[CaptureReport, dict[str, float]]:
    began = time.process_time()
    tracked = tracked_views(views, features)
    middle = time.process_time()
    report = surveyed(tracked, views)
    return report, {
        "matching_cpu_seconds": middle - began,
        "survey_cpu_seconds": time.process_time() - middle,
    }


def scene(views: list[View], others: list[View] | None, seed: int, only: Sequence[str]) -> dict[str, Any]:
    """Apply each kind of damage to one dataset, and judge the record of each."""
    features = FoundOnce(SIFT)  # most photos are the same in all cases
    plain, cost = survey(views, features)
    usual = {p: {photo.name for photo in plain.with_problem(p)} for photo in plain.photos for p in photo.problems}
    found = {"as it is": judged(Case(views), plain, usual) | cost}
    print("as it is", *found["as it is"]["summary"], sep="\n  ", flush=True)
    generator = torch.Generator().manual_seed(seed)
    cases: dict[str, Callable[[], Case]] = {
        "a side removed, blur, a pose": lambda: side_blur_and_pose(views, plain, generator),
        "poses, turned, mirrored, exposure": lambda: poses_turns_and_exposure(views, plain, generator),
        "one place": lambda: one_place(views, generator),
        "two photos": lambda: Case(views[:2]),
    }
    if others is not None:
        cases["two places"] = lambda: two_places(views, others)
    for name, make in cases.items():
        case = make()  # always made, so that each case draws the same random numbers as in a full run
        if only and name not in only:
            continue
        report, cost = survey(case.views, features)
        found[name] = judged(case, report, usual) | cost
        print(name, *found[name]["summary"], found[name]["problems"], sep="\n  ", flush=True)
    return found


def main() -> None:
    parser = _lab.parser(__doc__, "capture_report")
    parser.add_argument("data", nargs="+", type=Path, metavar="DATA")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*", default=[], help="cases to run, by name")
    given = parser.parse_args()
    _lab.one_thread()
    captures = [open_dataset(data).views("train") for data in given.data]
    results = {}
    for place, (data, views) in enumerate(zip(given.data, captures, strict=True)):
        others = captures[(place + 1) % len(captures)] if len(captures) > 1 else None
        print(data.name, flush=True)
        results[data.name] = scene(views, others, given.seed, given.only)
    _lab.record(given.name, results, given.seed)


if __name__ == "__main__":
    main()
