r"""Answers on record: what the localizer says to the same images, before and after a change of its code.

    python benchmarks/answer_maps.py MAP [MAP ...]
    python benchmarks/answers.py MAP [MAP ...] --name NAME [--share 0.1] [--only CONDITION ...]
    python benchmarks/answers.py MAP [MAP ...] --out A.jsonl
    python benchmarks/answers.py --compare A.jsonl [B.jsonl]
    python benchmarks/answers.py --record A.jsonl [A2.jsonl ...] --name NAME

MAP is the name of a dataset in the folder ``BIDNERF_DATA``, or that name with @K or @new, whose map ``answer_maps.py`` has put into the
folder ``BIDNERF_MAPS``; or ``planes``, the scenes of ``planar_scenes.py``. Images that training never saw are localized without a
start and on one thread, with depth and without, under the conditions that the table ``CONDITIONS`` lists. Each answer is kept
as a row with its pose, covariance (upper triangle, single precision), outcome, reason, confidence, errors and CPU time. The
same code gives the same rows on the same maps, to the bit, but for the time. An interrupted run resumes; several may run at a
time on different maps, each with its own file. All conditions advance alike, so that an unfinished run covers each of them.
``--share`` takes a part of the images, evenly spaced; ``--only`` takes all images of the test split, those for tuning
included, under the named conditions alone, such as "as it is" or "other scene".

Of the frames of a test split, those for tuning are left out if at least 15 others remain. Images of other scenes, of a bare
wall, and of a scene that stands twice have no right answer. Right for the average of two photos is the pose of either; right
for a photo of a picture of the scene, and for a mirrored one, is the pose from which the scene was seen. In ``planes``, where
scenes differ in size, errors of the position are relative to the distance of what is seen.

``--compare`` counts, over the answers that both files have, those that are right (within 5 degrees and 0.05 units), strictly
right (1 degree, 0.02), accepted, and silent (accepted and not right); how many of the accepted with a known error lie inside
the 95 % bound of their covariance; the median squared error of the right ones, in units of the covariance and relative to the
median of its distribution (1 for a true covariance), a Student-t distribution with the degrees of freedom that maps assume; how many
degrees are likeliest; and the median and the longest CPU time. Exact McNemar tests of both files follow, and how
many answers changed. ``--name`` joins the rows, or files of them, into ``results/NAME.rows.jsonl.xz``, and summarises them in
``results/NAME.json``.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import lzma
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from statistics import median
from typing import Any

import planar_scenes
import torch
from _doubled_map import double, far_away
from _lab import (
    FRAMES,
    RESULTS,
    STRICT,
    Row,
    RowStore,
    Scene,
    cpu_seconds,
    data_folder,
    errors_of,
    folder_of,
    judgement,
    one_thread,
    record,
    spread,
    within,
    without_depth,
    without_tuning,
)
from scipy.special import gammaln
from scipy.stats import binomtest, chi2, f
from torch import Generator, Tensor
from torch.nn.functional import interpolate

from bidnerf import Localizer
from bidnerf.evaluation import faulty, provenance, warp
from bidnerf_core.captures import ERROR_FREEDOM
from bidnerf_core.datasets import Capture, open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, random_units
from bidnerf_core.io import write_file
from bidnerf_core.localization import Evidence, Outcome, judge

SEED = 0
SCENES = ("phone_doll", "tum_fr1_xyz", "room_living", "blender_lego", "iphone_corridor", "blender_mic")
"""Photos of the next two count as photos of another scene."""
PLANES = "planes"
START_DEGREES = 5.0
TILT = {"tilted": math.radians(30), "full": math.radians(10)}
WALL_DISTANCE = 2.0
MEDIAN = float(chi2.ppf(0.95, 6) * f.median(6, ERROR_FREEDOM) / f.ppf(0.95, 6, ERROR_FREEDOM))
"""Median of squared errors in units of their covariance, of which 95 % lie within the 95 % bound of a Gaussian."""
ROUNDING = 1e-6
"""Smallest change of an entry of a pose that counts as one."""


# Conditions.


def generator_of(frame: Frame) -> Generator:
    """Return a source of random numbers that depends on the frame's name alone."""
    digest = hashlib.blake2b(f"{SEED}\n{frame.name}".encode(), digest_size=7).digest()
    return Generator().manual_seed(int.from_bytes(digest, "big"))


def resample(frame: Frame, rgb: Tensor, depth: Tensor | None, width: int, height: int) -> Frame:
    """Return the frame with images resized, but with the focal lengths and the principal point that it states."""
    rgb = interpolate(rgb.permute(2, 0, 1)[None], (height, width), mode="bilinear", antialias=True)[0]
    if depth is not None:
        depth = interpolate(depth[None, None], (height, width), mode="nearest")[0, 0]
    stated = replace(frame.intrinsics, width=width, height=height)
    rgb = rgb.permute(1, 2, 0).clamp(0, 1).contiguous()
    return replace(frame, rgb=rgb, depth=depth, alpha=None, hidden=None, intrinsics=stated)


def shrunk(frame: Frame) -> Frame:
    """Resize the images to three quarters, and state the camera of the original."""
    camera = frame.intrinsics
    return resample(frame, frame.rgb, frame.depth, round(0.75 * camera.width), round(0.75 * camera.height))


def corner(frame: Frame) -> Frame:
    """Enlarge a random quarter to the size of the whole, and state the camera of the whole."""
    camera = frame.intrinsics
    height, width = camera.height // 2, camera.width // 2
    right, low = (torch.rand(2, generator=generator_of(frame)) < 0.5).tolist()
    part = (slice(height * low, height * (1 + low)), slice(width * right, width * (1 + right)))
    depth = None if frame.depth is None else frame.depth[part]
    return resample(frame, frame.rgb[part], depth, camera.width, camera.height)


def brighten(frame: Frame) -> Frame:
    """Change the tone curve by a gamma of a half."""
    return replace(frame, rgb=frame.rgb.clamp(0, 1).sqrt())


def shear(frame: Frame) -> Frame:
    """Shift each row sideways by 15 % of its height above the middle."""
    pixels = frame.intrinsics.pixel_centres()
    shift = 0.15 * (pixels[..., 1] - frame.intrinsics.height / 2)
    return warp(frame, torch.stack([pixels[..., 0] + shift, pixels[..., 1]], dim=-1))


def picture(frame: Frame, kind: str) -> Frame:
    """Show the frame as a picture on a plane that is turned about a random axis in the image plane.

    ``tilted`` shows all of it before grey, ``full`` is so near that nothing else is seen. The depth is that of the plane, in
    the middle as far away as the median of what the picture shows.
    """
    camera, angle = frame.intrinsics, TILT[kind]
    turn = 2 * math.pi * float(torch.rand((), generator=generator_of(frame)))
    axis = torch.tensor([math.cos(turn), math.sin(turn), 0.0], dtype=torch.float64)
    T = SE3.exp(torch.cat([torch.zeros(3, dtype=torch.float64), angle * axis]))
    T = SE3(T.rotation, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    rays = camera.unproject(camera.pixel_centres(torch.float64))
    origin, directions = T.inverse().translation, T.inverse().rotate(rays)
    along = -origin[2] / directions[..., 2]
    at = (origin + along[..., None] * directions)[..., :2]
    reach = [float(at[..., side].abs().max() / rays[..., side].abs().max()) for side in (0, 1)]
    scale = max(reach) if kind == "full" else 0.8
    pixels = camera.project(torch.cat([at / scale, torch.ones_like(at[..., :1])], dim=-1))
    shown = warp(frame, pixels)
    size = pixels.new_tensor([camera.width, camera.height])
    outside = ((pixels < 0) | (pixels >= size)).any(-1)
    rgb = torch.where(outside[..., None], torch.full_like(shown.rgb, 0.6), shown.rgb)
    depth = None
    if frame.depth is not None:
        measured = frame.depth[frame.depth > 0]
        depth = ((measured.median() if len(measured) else 1.0) * along * rays[..., 2]).to(frame.depth)
    return replace(shown, rgb=rgb, depth=depth, alpha=None, hidden=None)


def wall(frame: Frame) -> Frame:
    """Show a bare wall instead: one colour with shading and noise, and the depth of a plane."""
    camera, generator = frame.intrinsics, generator_of(frame)
    colour = 0.5 + 0.3 * torch.rand(3, generator=generator)
    slope = torch.randn(2, generator=generator)
    rays = camera.unproject(camera.pixel_centres()).float()[..., :2]
    shade = 1 + 0.15 * (rays @ slope) / rays.norm(dim=-1).max()
    rgb = colour * shade[..., None] + 0.01 * torch.randn(frame.rgb.shape, generator=generator)
    depth = None if frame.depth is None else WALL_DISTANCE / (1 + 0.2 * (rays @ slope)).clamp_min(0.2)
    return replace(frame, rgb=rgb.clamp(0, 1).contiguous(), depth=depth, alpha=None, hidden=None)


@dataclass(frozen=True)
class Condition:
    """A change of the images, and the part of a map's frames that are shown under it."""

    change: str | Callable[[Frame], Frame] = "none"  # a fault by name, or a function
    share: float = 0.5
    needs_depth: bool = False
    has_answer: bool = True
    special: bool = False  # not only a change of an image; see ``Subject.question``


CONDITIONS = {
    "as it is": Condition(share=1.0),
    "focal 5 %": Condition("focal:1.05"),
    "crop 20 %": Condition("crop:0.2"),
    "crop 25 %": Condition("crop:0.25"),
    "stale size": Condition(shrunk),
    "mirrored": Condition("mirror:1", 0.34),
    "blur 2 px": Condition("blur:2", 0.25),
    "blur 3 px": Condition("blur:3", 0.25),
    "gamma 0.5": Condition(brighten),
    "covered 25 %": Condition("occluder:0.25"),
    "rolling shutter": Condition("rolling-shutter:2"),
    "sheared 15 %": Condition(shear, 0.34),
    "lens k1 -0.3": Condition("distortion:-0.3", 0.34),
    "lens k1 +0.3": Condition("distortion:0.3", 0.34),
    "picture tilted": Condition(lambda frame: picture(frame, "tilted"), 0.34),
    "picture full": Condition(lambda frame: picture(frame, "full"), 0.34),
    "corner enlarged": Condition(corner, 0.34),
    "two averaged": Condition(share=0.34, special=True),
    "depth 3 %": Condition("depth-scale:1.03", needs_depth=True),
    "depth 10 px": Condition("depth-shift:10", needs_depth=True),
    "other scene": Condition(share=1.0, has_answer=False, special=True),
    "twice": Condition(share=0.5, has_answer=False, special=True),
    "twice, start 5 deg": Condition(share=0.5, special=True),
    "plain wall": Condition(wall, 0.5, has_answer=False),
    "start 5 deg": Condition(share=0.5, special=True),
    "plane": Condition(special=True),
}


# Questions, and answers to them.

UNKNOWN = dict.fromkeys(
    (
        "translation",
        "rotation_deg",
        "normalized_error_squared",
        "pose",
        "covariance",
        "confidence",
        "evidence",
    )
)
"""What is not known of an image that could not be localized at all."""


@dataclass(frozen=True)
class Question:
    """An image, what localizes it, and the poses that are right, none if no pose is."""

    key: tuple[str, str, str, str]  # map, mode, condition, frame
    frame: Frame
    localizer: Localizer
    right: Sequence[View] = ()
    start: SE3 | None = None
    unit: float = 1.0  # in which errors of the position are counted

    def answer(self) -> Row:
        """Localize the image and return the row of the answer."""
        began = time.process_time()
        try:
            found = self.localizer(self.frame, self.start, seed=SEED)
        # What the localizer cannot take is behaviour too, and one such image must not end the record.
        except Exception as error:
            said = {"converged": False, "outcome": f"raised {type(error).__name__}", "reason": str(error)}
            return UNKNOWN | said | {"cpu_seconds": time.process_time() - began}
        seconds = time.process_time() - began
        errors = [errors_of(found, view) for view in self.right] or [errors_of(found, None)]
        if errors[0]["translation"] is not None:
            errors = [some | {"translation": some["translation"] / self.unit} for some in errors]
            errors.sort(key=lambda some: some["translation"])
        evidence = asdict(found.diagnostics) if isinstance(found.diagnostics, Evidence) else None
        pose, covariance = found.T_world_camera.matrix()[:3], found.covariance
        upper = None if covariance is None else covariance[tuple(torch.triu_indices(6, 6))]
        return errors[0] | {
            "pose": pose.tolist() if bool(pose.isfinite().all()) else None,
            # The shortest decimal numbers that are these in single precision, to keep the rows small.
            "covariance": None
            if upper is None or not bool(upper.isfinite().all())
            else [float(str(value)) for value in upper.float().numpy()],
            "converged": found.converged,
            "outcome": str(found.outcome),
            "reason": found.reason,
            "confidence": found.confidence,
            "cpu_seconds": seconds,
            "evidence": evidence,
        }


class Subject:
    """A map that is asked, and the images of its scene and of others."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.scene = Scene.open(name)
        self.content = self.scene.key
        self.localizer = Localizer(self.scene.map)
        scene = data_folder(name).name
        place = SCENES.index(scene) if scene in SCENES else 0
        self.others = [SCENES[(place + step) % len(SCENES)] for step in (1, 2)]

    @cached_property
    def frames(self) -> list[str]:
        """The frames of the test split without those for tuning, or all if too few would remain."""
        return without_tuning(self.scene.dataset.frame_names("test"))

    @cached_property
    def foreign(self) -> dict[str, tuple[Capture, str]]:
        """Frames of other scenes by name, alternately of each."""
        sets = {other: self.dataset(other) for other in self.others}
        names = {other: spread(data.frame_names("test"), FRAMES) for other, data in sets.items()}
        shortest = min(map(len, names.values()))
        return {
            f"{other}/{names[other][place]}": (data, names[other][place])
            for place in range(shortest)
            for other, data in sets.items()
        }

    @cached_property
    def localizer_of_two(self) -> Localizer:
        return Localizer(double(self.scene.map, far_away(self.scene.map.bounds)))

    def dataset(self, name: str) -> Capture:
        return open_dataset(folder_of("BIDNERF_DATA") / name, self.scene.map.bounds.background)

    @lru_cache(maxsize=64)  # noqa: B019
    def view(self, name: str) -> View:
        data, frame = self.foreign.get(name, (self.scene.dataset, name))
        return data.views("test", [frame])[0]

    def plan(self, share: float, only: Sequence[str]) -> Iterator[tuple[float, str, str, str]]:
        """Yield for each question how far down its condition's list it stands, mode, condition, and frame."""
        every = self.scene.dataset.frame_names("test")
        for condition, how in CONDITIONS.items():
            if condition == "plane" or (only and condition not in only):
                continue
            names = list(self.foreign) if condition == "other scene" else every if only else self.frames
            taken = spread(names, len(names) if only else round(FRAMES * how.share))
            taken = spread(taken, max(1, round(share * len(taken))))
            for place, name in enumerate(taken):
                has_depth = self.view(name).frame.has_depth
                for mode in ("RGB", "RGB-D") if has_depth else ("RGB",):
                    if mode == "RGB-D" or not how.needs_depth:
                        yield (place + 0.5) / len(taken), mode, condition, name

    def questions(
        self, share: float, only: Sequence[str]
    ) -> Iterator[tuple[tuple[str, str, str, str], Callable[[], Question]]]:
        """Yield keys and how to make their questions, so that all conditions advance alike."""
        for _, mode, condition, name in sorted(self.plan(share, only), key=lambda some: some[0]):
            key = (self.name, mode, condition, name)
            yield key, lambda key=key: self.question(key)  # type: ignore[misc]

    def question(self, key: tuple[str, str, str, str]) -> Question:
        _, mode, condition, name = key
        how, given = CONDITIONS[condition], self.view(name)
        view, right, start = given, [given], None
        if condition == "two averaged":
            other = self.view(self.frames[(self.frames.index(name) + len(self.frames) // 2) % len(self.frames)])
            view = replace(view, frame=replace(view.frame, rgb=(view.frame.rgb + other.frame.rgb) / 2))
            right = [given, other]
        elif condition.endswith("start 5 deg"):
            start = self.start(given)
        elif isinstance(how.change, str):
            view = faulty(view, how.change, SEED)
            right = [view]
        else:
            view = replace(view, frame=how.change(view.frame))
        if mode == "RGB":
            view = without_depth(view)
        localizer = self.localizer_of_two if condition.startswith("twice") else self.localizer
        return Question(key, view.frame, localizer, right if how.has_answer else (), start)

    def start(self, view: View) -> SE3:
        """Return a start turned by 5 degrees, and moved by as much as turns the median landmark by 5 degrees."""
        turn, move = random_units(2, generator_of(view.frame))
        landmarks = self.scene.map.landmarks
        if landmarks is None:
            raise InputError(f"{self.scene.folder}: a map without landmarks, expected one that was baked")
        T = view.T_ref_camera.to("cpu", torch.float64)
        distance = float((landmarks.positions.double() - T.translation).norm(dim=-1).median())
        angle = math.radians(START_DEGREES)
        return T.retract(torch.cat([math.tan(angle) * distance * move, angle * turn]))


class Planes:
    """The maps of scenes that are nearly planes, with images of them, and of a bare wall beside them."""

    QUERIES = 4

    def __init__(self, name: str) -> None:
        self.name = name
        self.content: list[Any] = [name]
        self._questions: list[tuple[tuple[str, str, str, str], Callable[[], Question]]] = []
        for number, scene in enumerate(planar_scenes.scenes()):
            generator = Generator().manual_seed(number)
            planar, localizer = planar_scenes.make_map(scene, generator)
            digest = hashlib.blake2b(planar.landmarks.positions.numpy().tobytes(), digest_size=6)
            self.content.append(digest.hexdigest())
            poses = scene.poses(self.QUERIES, generator)
            for i, T in enumerate(poses):
                view = scene.view(T, f"{scene.name}/{i}", generator)
                key = (name, "RGB", "plane", view.frame.name)
                made = Question(key, view.frame, localizer, [view], unit=scene.distance)
                self._questions.append((key, lambda made=made: made))  # type: ignore[misc]
            bare = replace(view, frame=wall(view.frame.replace(name=f"{scene.name}/wall")))
            key = (name, "RGB", "plain wall", bare.frame.name)
            asked = Question(key, bare.frame, localizer)
            self._questions.append((key, lambda asked=asked: asked))  # type: ignore[misc]

    def questions(
        self, share: float, only: Sequence[str]
    ) -> Iterator[tuple[tuple[str, str, str, str], Callable[[], Question]]]:
        yield from self._questions[:: max(1, round(1 / share))]


def run(names: Sequence[str], out: Path, share: float, only: Sequence[str]) -> None:
    """Ask all questions to which the file holds no answer yet."""
    with RowStore(out) as store:
        for name in names:
            subject = Planes(name) if name == PLANES else Subject(name)
            about = store.get(["about", name], lambda subject=subject: about_run(subject.content))  # type: ignore[misc]
            if about["content"] != subject.content:
                raise InputError(
                    f"{out}: has answers of another map of {name}, {about['content']}, expected those of"
                    f" {subject.content}; name another --out"
                )
            for key, question in subject.questions(share, only):
                store.get(list(key), lambda question=question: question().answer())  # type: ignore[misc]
            print(f"{name}: done", flush=True)


def about_run(content: Sequence[Any]) -> Row:
    """Return the content of a map, and the code that answers begin with."""
    run = provenance("", "")
    about = {"content": list(content), "commit": run.commit, "dirty": run.dirty, "seed": SEED}
    return about | {
        "python": run.python,
        "cpu": run.cpu,
        "versions": run.versions,
    }


# Counts and comparisons.


def read_rows(path: Path) -> dict[tuple[str, ...], Row]:
    """Return the rows of a file, also of a compressed one, by key: map, mode, condition, frame."""
    content = path.read_bytes()
    if path.suffix == ".xz":
        content = lzma.decompress(content)
    return {tuple(json.loads(key)): row for key, row in RowStore.parse(content).items()}


def answers_of(rows: dict[tuple[str, ...], Row]) -> dict[tuple[str, ...], Row]:
    return {key: row for key, row in rows.items() if key[0] != "about"}


def likeliest_freedom(groups: Sequence[Sequence[float]]) -> int | None:
    """Return the degrees of freedom, of 1 to 30, with which squared errors are likeliest to have a six-dimensional Student-t distribution.

    Each group has errors of its own scale, such as those of one map.
    """
    scales = torch.logspace(-2, 2, 161, dtype=torch.float64)[:, None]

    def log_likelihood(freedom: int) -> float:
        constant = gammaln((freedom + 6) / 2) - gammaln(freedom / 2) - 3 * math.log(freedom)
        of_groups = [torch.tensor(squared, dtype=torch.float64) for squared in groups]
        logs = [
            constant - 3 * scales.log() - (freedom + 6) / 2 * (squared / (freedom * scales)).log1p()
            for squared in of_groups
        ]
        return sum(float(log.sum(1).max()) for log in logs)

    return max(range(1, 31), key=log_likelihood) if any(groups) else None


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the counts of some answers."""
    judged, times = judgement(rows), cpu_seconds(rows)
    squared = [row["normalized_error_squared"] for row in rows if within(row)]
    known = [value for value in squared if value is not None]
    return {
        "n": len(rows),
        "right": sum(map(within, rows)),
        "strict": sum(within(row, STRICT) for row in rows),
        "accepted": judged["converged"],
        "silent": judged["silent"],
        "inside": judged["inside_95_of_converged"],
        "scale": median(known) / MEDIAN if known else None,
        "median_s": times["median_cpu_seconds"],
        "slowest_s": times["slowest_cpu_seconds"],
    }


TESTED: dict[str, Callable[[Row], bool]] = {
    "right": within,
    "strict": lambda row: within(row, STRICT),
    "accepted": lambda row: row["converged"],
    "silent": lambda row: row["converged"] and not within(row),
}


def mcnemar(first: Sequence[Row], second: Sequence[Row], test: Callable[[Row], bool]) -> tuple[int, int, float]:
    """Return how often only the first and only the second pass a test, and the p-value of the exact McNemar test."""
    pairs = [(test(a), test(b)) for a, b in zip(first, second, strict=True)]
    only = sum(a and not b for a, b in pairs), sum(b and not a for a, b in pairs)
    return *only, float(binomtest(only[0], sum(only)).pvalue) if sum(only) else 1.0


def without_time(row: Row) -> Row:
    return {name: value for name, value in row.items() if name != "cpu_seconds"}


def changes(first: Sequence[Row], second: Sequence[Row]) -> dict[str, int]:
    """Return how many pairs of answers differ at all, and in what."""
    pairs = list(zip(first, second, strict=True))
    parts = ("pose", "covariance", "outcome", "reason", "confidence")
    found = {"any": sum(without_time(a) != without_time(b) for a, b in pairs)}
    found |= {part: sum(a[part] != b[part] for a, b in pairs) for part in parts}
    return found | {"pose beyond rounding": sum(has_moved(a["pose"], b["pose"]) for a, b in pairs)}


def has_moved(first: list[list[float]] | None, second: list[list[float]] | None) -> bool:
    """Return whether two poses differ by more than rounding does, or only one is known."""
    if first is None or second is None:
        return first is not second
    return bool(
        (torch.tensor(first, dtype=torch.float64) - torch.tensor(second, dtype=torch.float64)).abs().max() > ROUNDING
    )


def cells(keys: Sequence[tuple[str, ...]]) -> dict[tuple[str, str, str], list[tuple[str, ...]]]:
    """Return the keys by map and mode, by condition and mode, and by mode, in the order of the tables."""
    conditions = list(CONDITIONS)
    found: dict[tuple[str, str, str], list[tuple[str, ...]]] = {}
    for key in sorted(keys, key=lambda key: (key[0], key[1])):
        found.setdefault((key[0], key[1], "all"), []).append(key)
    for key in sorted(keys, key=lambda key: (key[1], conditions.index(key[2]))):
        found.setdefault(("all", key[1], key[2]), []).append(key)
    for key in sorted(keys, key=lambda key: key[1]):
        found.setdefault(("all", key[1], "all"), []).append(key)
    found["all", "all", "all"] = list(keys)
    return found


def shown(counts: dict[str, Any]) -> list[str]:
    """Return counts as the cells of a table."""
    parts = [str(counts[name]) for name in ("right", "strict", "accepted", "silent")]
    parts.append("/".join(map(str, counts["inside"])))
    parts.append("-" if counts["scale"] is None else f"{counts['scale']:.2f}")
    return parts + [f"{counts[name]:.2f}" for name in ("median_s", "slowest_s")]


def compare(paths: Sequence[Path]) -> None:
    """Print tables of one or two files, in Markdown."""
    files = [answers_of(read_rows(path)) for path in paths]
    keys = [key for key in files[0] if all(key in rows for rows in files)]
    left_out = [len(rows) - len(keys) for rows in files]
    if not keys:
        raise InputError(f"{paths[0]}: no answers that all files have, expected some of the same maps")
    print(
        f"{len(keys)} answers"
        + (f" that both have; only in one: {left_out[0]}, {left_out[1]}" if len(files) > 1 else "")
    )
    print(
        "\n| map | mode | condition | n | right | strict | accepted | silent | inside 95 % | scale | median s | slowest s |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for (name, mode, condition), some in cells(keys).items():
        columns = zip(*(shown(summary([rows[key] for key in some])) for rows in files), strict=True)
        print(f"| {name} | {mode} | {condition} | {len(some)} | " + " | ".join(map(" / ".join, columns)) + " |")
    if len(files) == 1:
        return
    first, second = ([rows[key] for key in keys] for rows in files)
    print("\n| | only the first | only the second | p (exact McNemar) |\n|---|---|---|---|")
    for name, test in TESTED.items():
        only_first, only_second, p = mcnemar(first, second, test)
        print(f"| {name} | {only_first} | {only_second} | {p:.3g} |")
    print("\nChanged answers: " + ", ".join(f"{part} {count}" for part, count in changes(first, second).items()))


def judged_anew(row: Row) -> Row:
    """Return an answer by landmarks with the verdict of the stored model: a new fit of it needs no new answers."""
    if row.get("evidence") is None or row["outcome"] not in (Outcome.CONVERGED, Outcome.UNCERTAIN):
        return row
    found = judge(Evidence(**row["evidence"]))
    return row | {"converged": found.accepted, "outcome": str(found.outcome), "confidence": found.confidence}


def keep(paths: Sequence[Path], name: str) -> None:
    """Join files of rows into the record ``name``, with verdicts of the stored model, and summarise it."""
    rows: dict[tuple[str, ...], Row] = {}
    for path in paths:
        rows |= read_rows(path)
    rows = {key: judged_anew(row) for key, row in rows.items()}
    lines = (json.dumps({"key": json.dumps(key), "row": rows[key]}) + "\n" for key in sorted(rows))
    write_file(RESULTS / f"{name}.rows.jsonl.xz", lzma.compress("".join(lines).encode(), preset=9))
    answers = answers_of(rows)
    found: dict[str, Any] = {}
    for (scene, mode, condition), some in cells(list(answers)).items():
        found.setdefault(f"{scene}, {mode}", {})[condition] = summary([answers[key] for key in some])
    maps = {key[1]: [row["commit"], *row["content"]] for key, row in rows.items() if key[0] == "about"}
    groups: dict[tuple[str, str], list[float]] = {}
    for (scene, mode, condition, _), row in answers.items():
        if condition == "as it is" and within(row) and (squared := row["normalized_error_squared"]) is not None:
            groups.setdefault((scene, mode), []).append(squared)
    freedom = likeliest_freedom([*groups.values()])
    record(name, {"commit_and_content_of_maps": maps, "degrees_of_freedom": freedom, "counts": found}, SEED)


def main() -> None:
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("maps", nargs="*", metavar="MAP", help=f"name of a dataset, or {PLANES}")
    found.add_argument("--out", type=Path, metavar="JSONL", help="file of the rows")
    found.add_argument("--share", type=float, default=1.0, help="part of the images (default: %(default)s)")
    found.add_argument("--only", nargs="+", default=(), choices=CONDITIONS, metavar="CONDITION", help="conditions")
    found.add_argument("--compare", nargs="+", type=Path, metavar="ROWS", help="one or two files of rows")
    found.add_argument("--record", nargs="+", type=Path, metavar="ROWS", help="files of rows to join")
    found.add_argument("--name", help="of the record")
    given = found.parse_args()
    if [bool(given.maps), bool(given.compare), bool(given.record)].count(True) != 1:
        found.error("expected maps, or --compare, or --record")
    if given.compare:
        if len(given.compare) > 2:
            found.error(f"--compare has {len(given.compare)} files, expected one or two")
        compare(given.compare)
        return
    rows = given.record
    if given.maps:
        if not (given.out or given.name) or not 0 < given.share <= 1:
            found.error("expected --name or --out FILE for the rows of maps, and a --share above 0 and up to 1")
        one_thread()
        rows = [given.out or RESULTS / f"{given.name}.rows.jsonl"]
        run(given.maps, rows[0], given.share, given.only)
    if given.name:
        keep(rows, given.name)


if __name__ == "__main__":
    main()
