"""The thirteen kinds of defects that an earlier search with hostile inputs found, each as cases that fail where one is back.

python tests/robustness/findings.py [--only NUMBER ...]
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import time
import xml.dom.minidom
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from bidnerf_core import SE3, Frame, Intrinsics, Localizer, Tracker, load_map
from damage import POSTSCRIPT, zeros_png
from harness import (
    AUTO,
    CAMERA,
    MEMORY,
    QUICK,
    SECONDS,
    SMALL_FIELD,
    Check,
    Checks,
    Door,
    Outcome,
    begin,
    defects,
    end,
    localized,
    photo,
    run,
    sound_folder,
    tracker,
)


class Work:
    """Sound files, copies of them to be damaged, and the outcome of the last case."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.sound, self._count = folder, folder / "sound", 0
        self.sound.mkdir()
        sound_folder(self.sound, test=8)

    def copy(self) -> Path:
        self._count += 1
        return Path(shutil.copytree(self.sound, self.folder / f"copy{self._count}"))

    def case(self, name: str, door: Door, *endings: str, **options: Any) -> Check:
        """Run a case, which must end in one of ``endings`` (by default in any sound way)."""
        found = self.run(door, **options)
        wrong = defects(found)
        if endings and found.ending not in endings and not wrong:
            wrong = [f"{found.ending}: {found.last[:160]}"]
        return Check(name, tuple(wrong))

    def run(self, door: Door, seconds: float = SECONDS, **options: Any) -> Outcome:
        return run(door, self.folder / "case", seconds, **options)


def tensors(folder: Path, part: str, change: Callable[[dict[str, torch.Tensor]], object]) -> Path:
    """Change the tensors of a part of the map in ``folder``."""
    (path,) = (folder / "map").glob(f"{part}-*.safetensors")
    found = load_file(path)
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    change(found)
    save_file({name: value.contiguous() for name, value in found.items()}, path, metadata)
    return folder


def description(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    path = folder / "map" / "map.json"
    plain = json.loads(path.read_text())
    change(plain)
    path.write_text(json.dumps(plain))
    return folder


def result_line(folder: Path, change: Callable[[dict[str, Any]], object]) -> list[object]:
    """Change a line of results, and return the command that reports it beside the sound one."""
    row = json.loads((folder / "results.jsonl").read_text())
    other = json.loads(json.dumps(row))
    other["trial"]["seed"] += 1
    change(row)
    other["settings"] |= {key: 2.5 for key in row["settings"] if key not in other["settings"]}
    (folder / "results.jsonl").write_text(json.dumps(row) + "\n" + json.dumps(other) + "\n")
    return ["report", folder / "results.jsonl", "--out", folder / "page"]


def images_run_programs(work: Work) -> Checks:
    """1: an image with PostScript inside starts an external program."""
    here = work.copy()
    marker, program = here / "started", here / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {marker}\n")
    program.chmod(0o755)

    def found_first() -> None:
        os.environ["PATH"] = f"{program.parent}:{os.environ['PATH']}"

    for name in ("x.png", "x.jpg", "x.eps"):
        (here / name).write_bytes(POSTSCRIPT)
        start = ["--start", here / "pose.json", *QUICK]
        doors: dict[str, Door] = {
            "localize": ["localize", here / "map", here / name, "--hfov", "41", *start],
            "Frame.open": lambda path=here / name: Frame.open(path, hfov=41.0),
            "depth": lambda path=here / name: Frame.open(here / "photo.png", hfov=41.0, depth=path),
        }
        for door in doors:
            check = work.case(f"{door} {name}", doors[door], "refused", before=found_first)
            yield Check(check.name, (*check.wrong, *(["gs was started"] if marker.exists() else [])))
            marker.unlink(missing_ok=True)


def poses_lost(work: Work) -> Checks:
    """2: ``localize --out`` loses every pose unless the stop is Ctrl-C."""
    here = work.copy()
    slow = ["--json", "--perturb", "0.1", "5", "--method", "bid", "--max-steps", "150", "--rays", "256"]

    def kept(name: str, found: Outcome, least: int, path: Path) -> Check:
        number = len(json.loads(path.read_text())) if path.exists() else 0
        said = len(found.out.splitlines())
        wrong = [f"{number} poses in the file of {max(said, least)}"] if number < max(said, least) else []
        return Check(name, tuple(wrong + (["a traceback"] if "Traceback" in found.err else [])))

    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        out, log = here / f"{number.name}.json", here / "stop.log"
        child = begin(["localize", here / "map", here / "data", "--out", out, *slow], log)
        until = time.monotonic() + SECONDS
        while (
            len(
                (log.with_suffix(".out")).read_text().splitlines() if log.with_suffix(".out").exists() else ""
            )
            < 3
        ):
            time.sleep(0.01)
            if time.monotonic() > until:
                break
        os.kill(child, number)
        yield kept(number.name, end(child, log), 3, out)
    words = ["localize", here / "map", here / "data", "--perturb", "0.1", "5", *QUICK, "--out"]
    for name, more in (("closed pipe", []), ("closed pipe, --json", ["--json"])):
        out = here / f"{name}.json"
        reading, writing = os.pipe()
        os.close(reading)
        found = work.run([*words, out, *more], out=writing)
        os.close(writing)
        yield kept(name, found, 1, out)
    found = work.run([*words, here / "full.json"], out=Path("/dev/full"))
    yield kept("stdout on a full disk", found, 1, here / "full.json")
    long = here / ("x" * 249 + ".png")
    shutil.copy(here / "photo.png", long)
    shots = [here / "photo.png", long, "--hfov", "41", "--start", here / "pose.json", *QUICK]
    found = work.run(
        ["localize", here / "map", *shots, "--draw", here / "drawn", "--out", here / "long.json"]
    )
    yield kept("a name too long to draw", found, 2, here / "long.json")
    (here / "closed").touch()
    found = work.run([*words, here / "closed.json", "--draw", here / "closed" / "sub"])
    yield Check("a picture that cannot be written", tuple(defects(found)))


def trajectories_lost(work: Work) -> Checks:
    """3: ``track --out`` loses the trajectory on SIGTERM, and where one value is not finite."""
    here = work.copy()
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        out, log = here / f"{number.name}.json", here / "track.log"
        began = time.monotonic()
        whole = work.run(["track", here / "map", here / "data", "--out", here / "whole.json"])
        seconds = time.monotonic() - began
        child = begin(["track", here / "map", here / "data", "--out", out], log)
        time.sleep(0.8 * seconds)
        os.kill(child, number)
        found = end(child, log)
        rows = len(json.loads(out.read_text())) if out.exists() else 0
        wrong = [] if rows or found.ending == "done" else ["no frame in the file"]
        yield Check(f"track, {number.name}", tuple(wrong + defects(whole)))
    for name, number in (("1e30", 1e30), ("-1e30", -1e30), ("max", 3.4e38)):
        for part in ("rgb", "normals", "positions"):
            bad = tensors(work.copy(), "surface", lambda t, p=part, x=number: overflowing(t, p, x))
            check = work.case(
                f"track, {part} {name}", ["track", bad / "map", bad / "data", "--out", bad / "t.json"]
            )
            there = (bad / "t.json").exists() or not check.wrong
            yield Check(check.name, (*check.wrong, *([] if there else ["no file"])))
            shutil.rmtree(bad)


def overflowing(found: dict[str, torch.Tensor], part: str, number: float) -> None:
    for name in [name for name in found if part in name and found[name].is_floating_point()]:
        found[name] = torch.full_like(found[name], 1.0) * number


def captures_unguarded(work: Work) -> Checks:
    """4: capture records are read without the guards that all other parts of a map have."""
    makers: dict[str, Callable[[Path], object]] = {
        "a pipe": os.mkfifo,
        "link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
        "link to /dev/random": lambda path: path.symlink_to("/dev/random"),
        "4 GB": lambda path: (path.touch(), os.truncate(path, 4 * 2**30)),
        "a folder": Path.mkdir,
    }
    for name, make in makers.items():
        here = work.copy()
        (path,) = (here / "map").glob("capture-*")
        path.unlink()
        make(path)
        yield work.case(f"info, {name}", ["info", here / "map"], memory=MEMORY)


def inputs_overwritten(work: Work) -> Checks:
    """5: outputs replace inputs and parts of a map without a word."""
    known = ["--hfov", "41", "--start"]
    for name in ("map/map.json", "photo.png", "pose.json"):
        here = work.copy()
        before = (here / name).read_bytes()
        out = here / name if name.endswith(".json") else here / "p.json"
        words: list[object] = [
            "localize",
            here / "map",
            here / "photo.png",
            *known,
            here / "pose.json",
            *QUICK,
            "--out",
            out,
        ]
        if name == "photo.png":
            shot = next((here / "data" / "images").rglob("*.png"))
            before = shot.read_bytes()
            words = ["track", here / "map", here / "data", "--out", here / "t.json", "--plot", shot]
            name = str(shot.relative_to(here))
        found = work.run(words)
        wrong = defects(found) + ([] if (here / name).read_bytes() == before else ["the input is gone"])
        yield Check(f"{words[0]} over {Path(name).name}", tuple(wrong))
    here = work.copy()
    (weights,) = (here / "map").glob("weights-*")
    before = weights.read_bytes()
    work.run(
        ["evaluate", here / "map", here / "data", "--out", weights, "--trials", "1", "--workers", "1", *QUICK]
    )
    yield Check("evaluate over weights", () if weights.read_bytes() == before else ("the input is gone",))


def hostile_reports(work: Work) -> Checks:
    """6: names in results break the figures and the page, and reach the terminal raw."""
    for key in (
        r"$\frac{$",
        r"$x^{y$",
        r"$\badmacro{1}$",
        "$$",
        "\x1b[2Jkey",
        "nul\0key",
        "bell\x07key",
        "\u202eyek",
    ):
        words = result_line(work.copy(), lambda row, k=key: row["settings"].update({k: 1.5}))
        check = work.case(f"settings key {key!r}", words)
        yield Check(check.name, (*check.wrong, *broken_page(Path(str(words[-1])))))
    for name in ("map", "data"):
        words = result_line(work.copy(), lambda row, n=name: row["trial"].update({n: "a\0b"}))
        yield work.case(f"NUL in trial.{name}", words)
    words = ["report", work.sound / "results.jsonl", "--out", work.copy() / "page", "--title", "\udcff"]
    yield work.case("a title that is not text", words)
    words = result_line(work.copy(), lambda row: row.update(backend="\x1b[2J<script>\u202e"))
    check = work.case("backend with control characters", words)
    yield Check(check.name, (*check.wrong, *broken_page(Path(str(words[-1])))))


def broken_page(page: Path) -> list[str]:
    wrong = []
    text = (page / "index.html").read_text(errors="replace") if (page / "index.html").exists() else ""
    odd = {c for c in text if not c.isprintable() and c not in "\n\t\u2028\xa0\u2009\u202f"}
    wrong += [f"{sorted(odd)!r} in the page"] if odd else []
    for figure in page.glob("*.svg"):
        try:
            xml.dom.minidom.parse(str(figure))
        except Exception as error:
            wrong.append(f"{figure.name} is no XML: {str(error)[:60]}")
    return wrong


def wrong_tensors(work: Work) -> Checks:
    """7: tensors of a map that are finite but wrong."""
    for channels in (1, 7, 129, 4096):
        here = tensors(
            work.copy(), "landmarks", lambda t, c=channels: t.update(descriptors=resized(t["descriptors"], c))
        )
        yield work.case(f"descriptors of {channels} channels", lambda h=here: localized(h))
        shutil.rmtree(here)
    here = tensors(
        work.copy(), "landmarks", lambda t: t.update(positions=torch.full_like(t["positions"], 3e38))
    )
    yield work.case(
        "landmarks at 3e38, track", ["track", here / "map", here / "data", "--out", here / "t.json"]
    )
    yield work.case("landmarks at 3e38, localize", ["localize", here / "map", here / "data", *AUTO])
    for number in (-1e30, -1e4):
        here = tensors(work.copy(), "weights", lambda t, x=number: flooded(t, x))
        for method in (
            AUTO,
            ["--perturb", "0.1", "5", "--method", "bid-lm"],
            ["--perturb", "0.1", "5", *QUICK],
        ):
            words = ["localize", here / "map", here / "data", *method]
            yield work.case(f"weights of {number:g}, {method[-1]}", words)


def resized(tensor: torch.Tensor, channels: int) -> torch.Tensor:
    return tensor.repeat(1, -(-channels // tensor.shape[1]))[:, :channels]


def flooded(found: dict[str, torch.Tensor], number: float) -> None:
    found.update({n: torch.full_like(t, number) for n, t in found.items() if t.is_floating_point()})


def unchecked_frames(work: Work) -> Checks:
    """8: ``Frame``, seeds, times and starts that are not checked at the door."""
    rgb, depth, camera = torch.rand(24, 24, 3), torch.ones(24, 24), CAMERA
    spot = rgb.clone()
    spot[3, 4, 1] = float("nan")
    images: dict[str, Any] = {
        "one NaN": spot, "all NaN": torch.full_like(rgb, float("nan")), "inf": torch.full_like(rgb, float("inf")),
        "uint8": (255 * rgb).byte(), "bool": rgb > 0.5, "int64": (255 * rgb).long(), "numpy": rgb.numpy(), "sparse": rgb.to_sparse(),
        "meta": rgb.to("meta"), "complex": rgb.to(torch.complex64), "half": rgb.half(), "requires_grad": rgb.clone().requires_grad_(),
        "four channels": torch.rand(24, 24, 4), "another size": torch.rand(12, 24, 3), "a list": rgb.tolist(), "None": None,
    }  # fmt: skip
    sensors: dict[str, Any] = {
        "(h, w, 1)": depth[..., None], "numpy": depth.numpy(), "NaN": torch.full_like(depth, float("nan")), "negative": -depth,
        "int64": depth.long(), "a list": depth.tolist(), "another size": torch.ones(12, 12),
    }  # fmt: skip
    cameras: dict[str, Any] = {"None": None, "dict": {"fx": 32}, "text": "camera"}
    hidden: dict[str, Any] = {
        "list": [[True]],
        "text": "x",
        "(h, w, 1)": torch.zeros(24, 24, 1, dtype=torch.bool),
    }
    calls: dict[str, Callable[[], object]] = {}
    for name, value in images.items():
        calls[f"rgb {name}"] = lambda v=value: localized(work.sound, Frame("x", v, camera))
    for name, value in sensors.items():
        calls[f"depth {name}"] = lambda v=value: localized(work.sound, Frame("x", rgb, camera, v))
    for name, value in cameras.items():
        calls[f"camera {name}"] = lambda v=value: localized(work.sound, Frame("x", rgb, v))
    for name, value in hidden.items():
        calls[f"hidden {name}"] = lambda v=value: localized(work.sound, Frame("x", rgb, camera, hidden=v))
    lens = (-1e6,) * 14
    calls["distortion"] = lambda: localized(
        work.sound, Frame("x", rgb, Intrinsics(32.0, 32.0, 12.0, 12.0, 24, 24, lens))
    )
    for seed in (float("nan"), -1, 2**70, "x", None, 1.5):
        calls[f"seed {seed}"] = lambda s=seed: localized(work.sound, seed=s)
    for moment in ("5", 10**400, float("nan")):
        calls[f"time {str(moment)[:8]}"] = lambda m=moment: tracker(work.sound)(photo(work.sound), m)
    identity = torch.eye(3, dtype=torch.float64)
    poses: dict[str, Callable[[], Any]] = {
        "with gradient": lambda: SE3(identity.clone().requires_grad_(), torch.zeros(3, dtype=torch.float64)),
        "of many": lambda: SE3(identity.expand(2, 3, 3), torch.zeros(2, 3, dtype=torch.float64)),
        "NaN": lambda: np.full((4, 4), np.nan),
        "a list": lambda: [[1.0] * 4] * 4,
    }
    for name, make in poses.items():
        calls[f"start {name}"] = lambda m=make: localized(work.sound, start=m())
    calls["Tracker of a map"] = lambda: Tracker(load_map(work.sound / "map"))  # type: ignore[arg-type]
    calls["Localizer of a path"] = lambda: Localizer(str(work.sound / "map"))(photo(work.sound))
    for name, call in calls.items():
        yield work.case(name, call)


def narrow_help(work: Work) -> Checks:
    """9: help does not end in a narrow terminal."""
    for columns in (1, 2, 5, 10, 20):
        for command in ("localize", "info", "train"):

            def narrow(width: int = columns) -> None:
                os.environ["COLUMNS"] = str(width)

            yield work.case(
                f"{command} --help, {columns} columns", [command, "--help"], "done", seconds=12, before=narrow
            )


def plain_encodings(work: Work) -> Checks:
    """10: text that the terminal's encoding does not have."""
    for errors in ("strict", "surrogateescape"):  # as PYTHONIOENCODING=ascii and as LC_ALL=POSIX have them

        def ascii_only(errors: str = errors) -> None:
            sys.stdout = open(1, "w", 1, "ascii", errors, closefd=False)  # noqa: SIM115
            sys.stderr = open(2, "w", 1, "ascii", "backslashreplace", closefd=False)  # noqa: SIM115

        for words in (
            ["info", work.sound / "map"],
            ["localize", work.sound / "map", work.sound / "data"],
            ["train", "--help"],
        ):
            yield work.case(f"{words[0]}, {errors}", words, "done", before=ascii_only)


def large_numbers(work: Work) -> Checks:
    """11: numbers in a map's description that take long, or overflow."""

    def refinement(plain: dict[str, Any]) -> None:
        plain["pose_refinement"] = {
            "noise_before": 1e308,
            "noise_after": 1.0,
            "refined": True,
            "replaced": [],
        }

    changes: dict[str, Callable[[dict[str, Any]], object]] = {
        "noise_before 1e308": refinement,
        "a million layers": lambda plain: plain["config"].update(colour_layers=1_000_000),
        "200,000 cameras": lambda plain: plain.update(cameras=many(plain["cameras"], 200_000)),
        "seconds 1e308": lambda plain: plain.update(seconds=1e308),
    }
    for name, change in changes.items():
        here = description(work.copy(), change)
        yield work.case(f"info, {name}", ["info", here / "map"])
        yield work.case(
            f"localize, {name}", ["localize", here / "map", here / "photo.png", "--hfov", "40", *AUTO]
        )
        shutil.rmtree(here)


def many(cameras: list[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    return [cameras[number % len(cameras)] | {"name": f"{number:06}"} for number in range(count)]


PLUGINS = {
    "raises": "raise ValueError('broken\\nplugin')",
    "raises BaseException": "class Odd(BaseException): pass\nraise Odd('broken')",
    "raises KeyboardInterrupt": "raise KeyboardInterrupt",
    "raises SystemExit": "raise SystemExit(0)",
    "prints": "print('\\x1b[2J from a plugin')\nraise ImportError('no')",
}


def broken_plugins(work: Work) -> Checks:
    """12: a plugin that fails at its import in an unusual way."""
    for name, text in PLUGINS.items():
        here = work.copy()
        place = here / "site"
        (place / "evil-1.0.dist-info").mkdir(parents=True)
        (place / "evil-1.0.dist-info" / "METADATA").write_text(
            "Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n"
        )
        (place / "evil-1.0.dist-info" / "entry_points.txt").write_text(
            "[bidnerf.backends]\nevil = evil:backend\n"
        )
        (place / "evil.py").write_text(text + "\n")

        def install(place: Path = place) -> None:
            sys.path.insert(0, str(place))

        words = ["train", here / "data", "--out", here / "new", "--backend", "evil"]
        found = work.run(words, before=install)
        wrong = defects(found)
        if found.ending != "refused" or "evil" not in found.last:
            wrong.append(f"{found.ending}: {found.last[:120]}")
        yield Check(f"a plugin that {name}", tuple(wrong))


def memory_of_images(work: Work) -> Checks:
    """13: a small file of many pixels takes gigabytes, and devices that do not exist are accepted."""
    here = work.copy()
    (here / "large.png").write_bytes(zeros_png(9900, 6, 4))  # 98 megapixels, RGBA
    limit = 5 * 2**29
    yield work.case(
        "largest=640",
        lambda: Frame.open(here / "large.png", hfov=41.0, largest=640),
        memory=limit,
        seconds=60,
    )
    yield work.case("whole", lambda: Frame.open(here / "large.png", hfov=41.0), memory=3 * 2**30, seconds=60)
    start = ["--start", here / "pose.json", *QUICK]
    for device in ("cpu:5", "cuda:99", "meta"):
        words = ["localize", here / "map", here / "photo.png", "--hfov", "41", *start, "--device", device]
        yield work.case(f"device {device}", words, "refused", "wrong usage")
        train = [
            "train",
            here / "data",
            "--out",
            here / f"new {device}",
            *SMALL_FIELD,
            "--steps",
            "2",
            "--device",
            device,
        ]
        yield work.case(f"train, device {device}", train, "refused", "wrong usage")


FINDINGS: tuple[Callable[[Work], Checks], ...] = (
    images_run_programs, poses_lost, trajectories_lost, captures_unguarded, inputs_overwritten, hostile_reports, wrong_tensors,
    unchecked_frames, narrow_help, plain_encodings, large_numbers, broken_plugins, memory_of_images,
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", type=int, nargs="+", default=range(1, len(FINDINGS) + 1))
    given = parser.parse_args()
    failed = 0
    with TemporaryDirectory() as place:
        work = Work(Path(place))
        for number in given.only:
            found = list(FINDINGS[number - 1](work))
            bad = [check for check in found if check.wrong]
            failed += len(bad)
            print(
                f"{FINDINGS[number - 1].__doc__}  {len(found) - len(bad)} of {len(found)} cases sound",
                flush=True,
            )
            for check in bad:
                print(f"  {check.name}: {'; '.join(check.wrong)}")
    sys.exit(failed > 0)


if __name__ == "__main__":
    main()
