"""Tables of results, made from the records in ``benchmarks/results``, so that no figure in the documentation is typed by hand.

A page holds a table between ``<!-- generated: NAME -->`` and ``<!-- end -->``. ``python docs/tables.py`` rewrites all of them;
a test compares the pages with the records.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from bidnerf_core.evaluation import FAULTS
from bidnerf_core.registry import list_plugins

ROOT = Path(__file__).parents[1]
RECORDS = ROOT / "benchmarks" / "results"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
BLOCK = re.compile(r"(<!-- generated: ([a-z-]+) -->\n).*?(<!-- end -->)", re.DOTALL)

SCENES = {
    "blender_lego": "Lego",
    "room_living": "room",
    "tum_fr1_xyz": "TUM",
    "iphone_corridor": "corridor",
    "phone_doll": "doll",
}
"""What the scenes of the records are called in the tables."""

Record = dict[str, Any]
Row = Iterable[object]


class Records:
    """The records in a folder, which remembers those that it has read."""

    def __init__(self, folder: Path = RECORDS) -> None:
        self.folder = folder
        self.used: dict[str, Record] = {}

    def __getitem__(self, name: str) -> Any:
        """Return the results of a record."""
        if name not in self.used:
            self.used[name] = json.loads((self.folder / f"{name}.json").read_text(encoding="utf-8"))
        return self.used[name]["results"]

    def caption(self) -> str:
        """Return a line with the name, date, commit and hardware of each record that was read."""
        groups: dict[tuple[str, str], list[str]] = {}
        for name, record in self.used.items():
            groups.setdefault((_when(record), _hardware(record)), []).append(f"`{name}`")
        parts = [f"{', '.join(names)} ({when}; {machine})" for (when, machine), names in groups.items()]
        return f"*Records: {'; '.join(parts)}.*\n"


def _when(record: Record) -> str:
    date = datetime.fromisoformat(record["date"])
    return f"{date.day} {date:%B %Y}, {record['commit'][:7]}"


def _hardware(record: Record) -> str:
    if record.get("gpu"):
        return " ".join(str(record["gpu"]).split()[:2])
    cpu = re.sub(r"\(R\)| Processor| @.*", "", record["cpu"])
    return f"{record['cores']} cores of an {cpu}"


TABLES: dict[str, Callable[[Records], str]] = {}


def table(make: Callable[[Records], str]) -> Callable[[Records], str]:
    """Register a function under its name as a table of the documentation."""
    TABLES[make.__name__.replace("_", "-")] = make
    return make


def rendered(page: str, folder: Path = RECORDS) -> str:
    """Return a page in which each generated block has been made anew from the records."""

    def block(found: re.Match[str]) -> str:
        records = Records(folder)
        return f"{found[1]}{TABLES[found[2]](records)}{found[3]}"

    return BLOCK.sub(block, page)


def _table(head: Row, rows: Iterable[Row], records: Records) -> str:
    return f"{_lines(head, rows)}\n{records.caption()}"


def _lines(head: Row, rows: Iterable[Row]) -> str:
    """Return a table in Markdown. Raises ``ValueError`` for a row of another length than the head."""
    head = list(head)
    first, *others = (
        f"| {' | '.join(str(cell) for _, cell in zip(head, row, strict=True))} |\n" for row in [head, *rows]
    )
    return f"{first}|{'---|' * len(head)}\n{''.join(others)}"


def _seconds(value: float) -> str:
    return f"{value:.2g} s"


def _length(value: float) -> str:
    return f"{value:.4f}" if value < 0.01 else f"{value:.3f}"


# Localization without a start, and with faults


@dataclass(frozen=True)
class Counts:
    """How the answers to some images turned out."""

    n: int = 0
    right: int = 0  # within 5 degrees and 0.05
    strict: int = 0  # within 1 degree and 0.02
    accepted: int = 0
    silent: int = 0  # accepted but wrong
    rejected: int = 0  # right but rejected
    inside: int = 0  # accepted, and the truth within the 95 % bound of the covariance
    bounded: int = 0  # accepted, with a covariance

    @classmethod
    def of(cls, cell: Record) -> Counts:
        """Return the counts of a cell of a record of ``benchmarks/faults.py``."""
        inside, bounded = cell["inside_95_of_converged"]
        return cls(
            n=cell["n"],
            right=cell["right"],
            strict=cell["strict"],
            accepted=cell["converged"],
            silent=cell["silent"],
            rejected=cell["right_but_rejected"],
            inside=inside,
            bounded=bounded,
        )

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))


def _total(counts: Iterable[Counts]) -> Counts:
    return sum(counts, Counts())


FAULTED = {"RGB": ("faults_rgb", "faults_rgb_tum"), "RGB-D": ("faults_rgbd", "faults_rgbd_tum")}
"""Records of method ``auto`` under faults: of all scenes, and of TUM on the map that knows how its camera moved."""


def _cells(records: Records, sensor: str) -> dict[str, dict[str, Record]]:
    """Return the cells of each scene and fault for a sensor."""
    every, tum = FAULTED[sensor]
    return {
        scene: records[tum if scene == "tum_fr1_xyz" else every]["cells"][scene][sensor]
        for scene in SCENES
        if scene in records[every]["cells"]
    }


CLEAN = {"RGB": "no_start_rgb", "RGB-D": "no_start_rgbd"}
"""Records of method ``auto`` on images without faults."""


@table
def no_start(records: Records) -> str:
    """Unchanged images, localized by ``auto`` without a start."""
    head = (
        "scene", "input", "images", "within 5°, 0.05", "within 1°, 0.02", "accepted", "of these wrong",
        "inside the 95 % bound", "median CPU time",
    )  # fmt: skip
    rows = []
    for scene, title in SCENES.items():
        for sensor, record in CLEAN.items():
            if cell := records[record]["cells"].get(scene, {}).get(sensor, {}).get("none"):
                c = Counts.of(cell)
                inside = f"{c.inside} of {c.bounded}"
                time = _seconds(cell["median_cpu_seconds"])
                rows.append((title, sensor, c.n, c.right, c.strict, c.accepted, c.silent, inside, time))
    return _table(head, rows, records)


@table
def headline(records: Records) -> str:
    """README's sentence about localization without a start."""
    found, times = {}, []
    for sensor, record in CLEAN.items():
        clean = [cells[sensor]["none"] for cells in records[record]["cells"].values()]
        found[sensor] = (_total(map(Counts.of, clean)), len(clean))
        times += [cell["median_cpu_seconds"] for cell in clean]
    rgb, rgbd = found["RGB"], found["RGB-D"]
    wrong = rgb[0].silent + rgbd[0].silent
    accepted = rgb[0].accepted + rgbd[0].accepted
    text = (
        f"Without a start, it localizes {rgb[0].right} of {rgb[0].n} held-out RGB images of {rgb[1]} scenes and "
        f"{rgbd[0].right} of {rgbd[0].n} RGB-D images of {rgbd[1]} scenes to within 5 degrees and 0.05 units. It accepts "
        f"{accepted} of these poses, of which {wrong or 'none'} {'is' if wrong < 2 else 'are'} wrong. An image takes {min(times):.1f} to {max(times):.1f} seconds of "
        f"CPU time (median of a scene). [Results](docs/results.md) has all tables."
    )
    return f"{textwrap.fill(text, 118)}\n\n{records.caption()}"


@table
def peers(records: Records) -> str:
    """Method ``auto`` beside SIFT with PnP, on RGB images."""
    names = {
        "auto": "`auto`",
        "sift + pnp (pycolmap)": "SIFT, PnP (pycolmap)",
    }
    rows = []
    for scene, sensors in records["landmark_peers"]["scenes"].items():
        for name, title in names.items():
            p = sensors["RGB"]["peers"][name]
            rows.append(
                (SCENES[scene], title, p["n"], p["5deg 0.05"]["successes"], p["1deg 0.02"]["successes"],
                 _length(p["median_translation"]), p["accepted"], p["silent"], _seconds(p["median_cpu_seconds"]))
            )  # fmt: skip
    head = (
        "scene", "method", "images", "within 5°, 0.05", "within 1°, 0.02", "median error", "accepted",
        "of these wrong", "median CPU time",
    )  # fmt: skip
    return _table(head, rows, records)


@table
def registration(records: Records) -> str:
    """The surface search of ``auto`` beside registration of point clouds, on RGB-D images."""
    names = {
        "auto": "`auto`, surface only",
        "open3d icp": "RANSAC, ICP (Open3D)",
        "gicp": "GICP from a start 0.5 away",
    }
    rows = []
    for record, scene in {"lego": "blender_lego", "room": "room_living", "tum": "tum_fr1_xyz"}.items():
        methods = records[f"registration_{record}"]["methods"]
        for name, title in names.items():
            m = methods[name]
            rows.append(
                (SCENES[scene], title, m["n"], m["5deg 0.05"]["successes"], m["1deg 0.02"]["successes"],
                 _length(m["median_translation"]), f"{m['cpu_seconds_against_auto']:.2g}")
            )  # fmt: skip
    head = (
        "scene", "method", "images", "within 5°, 0.05", "within 1°, 0.02", "median error",
        "CPU time over that of `auto`",
    )  # fmt: skip
    return _table(head, rows, records)


def _by_fault(records: Records) -> dict[str, dict[str, Counts]]:
    """Return the counts of each fault and sensor, over all scenes."""
    found: dict[str, dict[str, Counts]] = {}

    def add(sensor: str, cells: dict[str, Record]) -> None:
        for fault, cell in cells.items():
            by_sensor = found.setdefault(fault, {})
            by_sensor[sensor] = by_sensor.get(sensor, Counts()) + Counts.of(cell)

    for sensor in FAULTED:
        for cells in _cells(records, sensor).values():
            add(sensor, cells)
    for name in ("faults_camera", "faults_nominal"):
        for sensors in records[name]["cells"].values():
            add("RGB", sensors["RGB"])
    return found


@table
def faults(records: Records) -> str:
    """Method ``auto`` without a start, under each fault."""
    found, outcomes = _by_fault(records), ("right", "accepted but wrong", "right but rejected")
    head = ["fault"]
    for sensor in FAULTED:
        n = max(counts[sensor].n for counts in found.values() if sensor in counts)
        head += [f"{sensor}, of {n}: right", *(f"{sensor}: {outcome}" for outcome in outcomes[1:])]
    rows = []
    for fault, counts in sorted(found.items(), key=_fault_order):
        row: list[object] = [f"`{_shown(fault)}`"]
        for sensor in FAULTED:
            c = counts.get(sensor)
            row += [c.right, c.silent, c.rejected] if c else ["", "", ""]
        rows.append(row)
    return _table(head, rows, records)


def _shown(name: str) -> str:
    """Return faults as ``--fault`` takes them, without the size of those that are just on or off."""
    parts = (part.partition(":") for part in name.split("+"))
    return "+".join(
        kind if kind in FAULTS and FAULTS[kind].is_switch else kind + mark + size
        for kind, mark, size in parts
    )


def _fault_order(item: tuple[str, Any]) -> tuple[object, ...]:
    name, _, size = item[0].partition(":")
    number = re.match(r"[\d.]+", size)
    return (item[0] != "none", "+" in item[0], name, float(number[0]) if number else 0.0, item[0])


@table
def catalogue(_: Records) -> str:
    """All faults that ``evaluate --fault`` knows."""
    rows = []
    for name in (info.name for info in list_plugins("faults") if info.is_bundled):
        fault = FAULTS[name]
        neutral = "-" if fault.neutral is None else f"{fault.neutral:g}"
        unit = "" if fault.is_switch else fault.unit
        sizes = "" if fault.is_switch else ", ".join(f"{size:g}" for size in fault.sizes)
        if fault.neutral is not None and fault.neutral == fault.allowed.most:
            neutral = "all"
        rows.append((f"`{name}`", fault.summary, unit, "" if fault.is_switch else neutral, sizes))
    return _lines(("name", "fault", "size", "neutral size", "sizes tried"), rows)


@table
def unknown(records: Records) -> str:
    """Images to which no answer is right, or more than one."""
    rows = []
    for sensor, name in {"RGB": "faults_foreign", "RGB-D": "faults_foreign_rgbd"}.items():
        c = Counts.of(records[name]["all"])
        rows.append((f"{sensor} images of another scene", c.n, c.accepted, c.silent))
    for query, title in {
        "RGB": "RGB, scene present twice",
        "RGB-D": "RGB-D, scene present twice",
        "RGB, start": "RGB, scene present twice, with a start near one copy",
    }.items():
        parts = [records[name]["all"][query] for name in ("repeated_scene", "repeated_scene_lego")]
        n, accepted, right = (
            sum(part[key] for part in parts) for key in ("n", "believed", "believed and right")
        )
        rows.append((title, n, accepted, accepted - right))
    return _table(("images", "number", "accepted", "of these wrong"), rows, records)


@table
def covariance(records: Records) -> str:
    """How honest the acceptance and the covariance are, over all faults."""
    rows = []
    for sensor, confidence in {"RGB": "faults_rgb", "RGB-D": "faults_rgbd"}.items():
        by_scene = {
            scene: _total(map(Counts.of, cells.values())) for scene, cells in _cells(records, sensor).items()
        }
        for scene, c in [*by_scene.items(), ("all", _total(by_scene.values()))]:
            error = records["reliability"][confidence]["right"][scene]["expected_calibration_error"]
            rows.append(
                (SCENES.get(scene, "all"), sensor, c.n, c.accepted, c.silent, c.rejected,
                 f"{c.inside} of {c.bounded}", f"{error:.3f}")
            )  # fmt: skip
    head = (
        "scene", "input", "answers", "accepted", "of these wrong", "right but rejected", "inside the 95 % bound",
        "calibration error of `confidence`",
    )  # fmt: skip
    return _table(head, rows, records)


@table
def risk(records: Records) -> str:
    """What a stated risk is worth: the share of wrong answers among the accepted ones, and how many right ones it costs."""
    record = records["risk"]

    def counted(found: Record) -> str:
        return f"{found['wrong']} of {found['accepted']}"

    rows = []
    for risk, halves in record["other_halves"].items():
        tested, scenes = record["other_faults"], record["scene_left_out"]
        worst = max(
            scenes, key=lambda scene: scenes[scene][risk]["wrong"] / max(scenes[scene][risk]["accepted"], 1)
        )
        if halves["halves_with_a_threshold"]:
            rows.append(
                (f"{float(risk):.1%}", counted(tested[risk]), f"{tested[risk]['right_lost']} of {tested['right']}",
                 f"{halves['exceeded']} of {halves['halves_with_a_threshold']}",
                 f"{counted(scenes[worst][risk])} ({SCENES.get(worst, worst)})")
            )  # fmt: skip
    head = (
        "stated risk", "other faults: wrong of accepted", "right answers lost", "halves in which the risk is exceeded",
        "worst scene when left out: wrong of accepted",
    )  # fmt: skip
    return _table(head, rows, records)


@table
def answers(records: Records) -> str:
    """Answers to the same images in the same maps, before and after the localizer became one loop."""
    before, now = records["answers_before"]["counts"], records["answers"]["counts"]
    rows = []
    for name in (name for name, some in now.items() if "all" in some):
        cells = [counts[name]["all"] for counts in (before, now)]
        row: list[object] = [*name.split(", "), cells[0]["n"]]
        row += [
            " / ".join(str(cell[column]) for cell in cells)
            for column in ("right", "strict", "accepted", "silent")
        ]
        row.append(" / ".join(_seconds(cell["median_s"]) for cell in cells))
        rows.append(row)
    head = (
        "scene",
        "input",
        "answers",
        "right",
        "within 1°, 0.02",
        "accepted",
        "accepted but wrong",
        "median CPU time",
    )
    return _table(head, rows, records)


@table
def other_answers(records: Records) -> str:
    """Answers to images, in maps, that no bound and no confidence was fitted to."""
    rows = []
    for name, some in records["answers_other_frames"]["counts"].items():
        if (cell := some.get("all")) is not None:
            counts = [cell[column] for column in ("n", "right", "strict", "accepted", "silent")]
            times = [_seconds(cell[column]) for column in ("median_s", "slowest_s")]
            rows.append((*name.split(", "), *counts, " of ".join(map(str, cell["inside"])), *times))
    return _table(
        ("scene", "input", "answers", "right", "within 1°, 0.02", "accepted", "accepted but wrong", "inside the 95 % bound",
         "median CPU time", "slowest"),
        rows, records,
    )  # fmt: skip


@table
def conditions(records: Records) -> str:
    """Queries that differ from the images of the map."""
    titles = {
        "as it is": "unchanged",
        "half resolution": "half the resolution",
        "double resolution": "twice the resolution",
        "focal length 2 % longer": "another camera, focal length 2 % longer",
        "focal length 4 % longer": "another camera, focal length 4 % longer",
        "focal length 43 % longer": "another camera, focal length 43 % longer",
        "rig of three frames": "a rig of three frames",
    }
    scenes = ("phone_doll", "iphone_corridor")
    rows = []
    for condition, title in titles.items():
        row: list[object] = [title]
        for scene in scenes:
            c = records["query_conditions"][scene][condition]
            row += [_of(c["5deg 0.05"]), c["accepted_but_wrong"]]
        rows.append(row)
    columns = ("right", "accepted but wrong")
    head = ("query", *(f"{scene.split('_')[1]}: {column}" for scene in scenes for column in columns))
    return _table(head, rows, records)


@table
def detectors(records: Records) -> str:
    """Poses by landmarks of each detector, from maps of few photos and under other conditions."""
    scenes, names = ("phone_doll", "iphone_corridor"), ("sift", "xfeat", "sift-xfeat")
    rows = []
    for condition, title in {
        "every 2, as it is": "every 2nd photo in the map",
        **{
            f"every 2, {name}": f"the same, {name}"
            for name in ("half resolution", "double resolution", "night")
        },
        **{f"every {k}, as it is": f"every {k}th photo in the map" for k in (4, 8, 16)},
    }.items():
        row: list[object] = [title]
        for scene in scenes:
            cells = records["detectors"][scene][condition]
            row += [f"{cells[name]['right']} of {cells[name]['n']}" for name in names]
        rows.append(row)
    times = [
        records["detectors"][scene]["every 2, as it is"][name]["times_slower"]
        for scene in scenes
        for name in names
    ]
    rows.append(["time of a query, of SIFT's", *(f"{time:.1f}" for time in times)])
    head = ("queries right", *(f"{SCENES[scene]}: `{name}`" for scene in scenes for name in names))
    return _table(head, rows, records)


@table
def rolling_shutter(records: Records) -> str:
    """Poses by landmarks, with and without the motion during the readout."""
    rows = []
    for scene, title in SCENES.items():
        for fault, name in {"0": "unchanged", "0.5": "0.5°", "2": "2°"}.items():
            if fault != "2" and scene != "tum_fr1_xyz":
                continue
            cells = records["rolling_shutter"][scene][fault]
            row: list[object] = [title, name]
            for key in ("with motion", "taken as still"):
                c, bound = cells[key], cells[key]["inside_95"]
                row += [f"{_length(c['median_translation'])}, {c['median_rotation_deg']:.2f}°",
                        f"{bound['successes']} of {bound['trials']}"]  # fmt: skip
            rows.append((*row, cells["with motion"]["show_a_motion"]))
    head = (
        "scene", "turn during the readout", "median error with motion", "inside the 95 % bound",
        "median error without motion", "inside the 95 % bound", "images in which a motion is detected",
    )  # fmt: skip
    return _table(head, rows, records)


# Tracking


SEQUENCES = {
    "in order": "in order",
    "every 4th": "every fourth frame",
    "backwards": "backwards",
    "covered for 15 frames": "covered for 15 frames",
    "carried 100 frames on": "100 frames left out",
    "plain wall for 30 frames": "a plain wall for 30 frames",
    "half the image covered": "half of the image covered",
    "depth stops": "depth stops",
    "no time stamps": "no time stamps",
}


@table
def tracking(records: Records) -> str:
    """The tracker on two sequences, unchanged and with faults."""
    rows = []
    for record, scene in {"tracking": "tum_fr1_xyz", "tracking_corridor": "iphone_corridor"}.items():
        runs = records[record][scene]
        for sequence, name in SEQUENCES.items():
            if f"RGB, {sequence}" in runs:
                both = (runs[f"{sensor}, {sequence}"] for sensor in FAULTED)
                rows.append((f"{SCENES[scene]}, {name}", *(value for run in both for value in _tracked(run))))
    columns = ("accepted", "of these wrong", "median error, m", "inside the 95 % bound")
    head = ("sequence", *(f"{sensor}: {column}" for sensor in FAULTED for column in columns))
    return _table(head, rows, records)


def _tracked(run: Record) -> Iterator[object]:
    yield f"{run['accepted']} of {run['frames']}"
    yield run["accepted_but_wrong"]
    yield _length(run["errors"]["raw"]["translation_median"])
    yield f"{100 * run['inside_95']:.0f} %"


@table
def tracking_baseline(records: Records) -> str:
    """The tracker beside generalised ICP, on the same frames of TUM."""
    runs = records["tracking"]["tum_fr1_xyz"]
    rows = []
    for name, title in {
        "RGB-D, in order": "tracker",
        "RGB-D, GICP from the last pose": "generalised ICP from the last pose (small_gicp)",
    }.items():
        run = runs[name]
        raw = run["errors"]["raw"]
        rows.append(
            (title, f"{run['accepted']} of {run['frames']}", run["accepted_but_wrong"],
             f"{_length(raw['translation_median'])}, {raw['rotation_deg_median']:.2f}°",
             _length(raw["translation_p95"]), f"{run['cpu_ms']['median']:.0f} ms")
        )  # fmt: skip
    head = ("method", "accepted", "of these wrong", "median error", "95 % quantile, m", "CPU per frame")
    return _table(head, rows, records)


# Maps and backends


@table
def maps(records: Records) -> str:
    """What ``bidnerf train`` makes of the scenes with default settings."""
    maps = {
        "map_blender_lego": "Lego",
        "map_room_living": "room",
        "map_room_living_rgb": "room, depth withheld",
        "map_tum_fr1_xyz": "TUM",
        "map_tum_without_motions": "TUM, motion during the readout ignored",
        "map_iphone_corridor": "corridor",
        "map_phone_doll": "doll",
    }
    rows = [(title, *_map_quality(records[name])) for name, title in maps.items()]
    return _table(("scene", *MAP_COLUMNS), rows, records)


MAP_COLUMNS = (
    "PSNR", "after a gain and an offset", "at poses by landmarks", "median depth error", "time", "CPU time", "memory",
)  # fmt: skip


def _map_quality(result: Record) -> Iterator[str]:
    full, training = result["levels"][-1], result.get("training") or {}
    at_landmarks = (result.get("at_landmark_poses") or {}).get("refined") or {}
    yield _decibels(full.get("psnr_mean_dB"))
    yield _decibels(full.get("psnr_fitted_mean_dB"))
    yield _decibels(at_landmarks.get("psnr_mean_dB"))
    yield _length(full["depth_error_median"]) if full.get("depth_error_median") else "-"
    yield f"{training['seconds'] / 60:.1f} min" if training else "-"
    yield f"{training['cpu_seconds'] / 60:.1f} min" if "cpu_seconds" in training else "-"
    yield f"{training['peak_resident_GiB']:.1f} GiB" if training else "-"


def _decibels(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f} dB"


@table
def backends(records: Records) -> str:
    """Backends with their default settings on the same data."""
    trained = {
        "map_blender_lego": "hashgrid",
        "map_lego_vanilla": "vanilla",
        "map_lego_adanerf": "adanerf",
    }
    rows = []
    for name, backend in trained.items():
        result = records[name]
        quality, minutes = result["levels"][-1], result["training"]["seconds"] / 60
        error = _length(quality["depth_error_median"])
        rows.append((f"`{backend}`", _decibels(quality["psnr_mean_dB"]), error, f"{minutes:.0f} min"))
    head = ("backend", "PSNR", "median depth error", "training")
    return _table(head, rows, records)


@table
def steps(records: Records) -> str:
    """A step of ``bid`` with 2048 rays on a GPU."""
    names = {"blender_lego": "hashgrid"}
    rows = []
    for field, levels in records["gpu_steps"]["steps"].items():
        for level, m in levels.items():
            coarse = level == "level 0" and len(levels) > 1
            rows.append(
                (f"`{names.get(field, field)}`", "coarse" if coarse else "full detail", f"{m['launched_ms']:.1f} ms",
                 f"{m['graph_ms']:.1f} ms", f"{m['kernels']:.0f}")
            )  # fmt: skip
    head = ("backend", "level", "operations launched one by one", "replayed as a CUDA graph", "kernels")
    return _table(head, rows, records)


# The paper's experiments


def _successes(
    records: Records, name: str, condition: str, start: str = "bid, all sizes", within: str = "10%"
) -> str:
    cells = records[name]["cells"]
    (cell,) = [c for c in cells if c["condition"] == condition and c["start"] == start]
    return _of(cell["criteria"][within])


def _of(rate: Any) -> str:
    """Return a count of a record, ``[successes, trials]`` or with intervals and steps, as "successes of trials"."""
    if isinstance(rate, list):
        return f"{rate[0]} of {rate[1]}"
    rate = rate.get("rate", rate)
    return f"{rate['successes']} of {rate['trials']}"


TABLE_1 = {
    "table1_blender_lego": "Lego, `hashgrid`",
    "table1_lego_vanilla": "Lego, `vanilla`",
    "table1_chair": "chair, `hashgrid`",
}


@table
def paper_depth(records: Records) -> str:
    """The paper's Table 1: depth and level of detail."""
    rows = []
    for sensor in ("RGB-D", "RGB"):
        for level, name in {"0": "coarse", "none": "fine"}.items():
            paper = records["table1_blender_lego"]["paper_percent"][f"{sensor} {name}"]
            condition = f"bid, {sensor}, level {level}"
            found = (_successes(records, record, condition) for record in TABLE_1)
            rows.append((f"{sensor}, {name}", f"{paper:.0f} %", *found))
    return _table(("compared", "paper", *TABLE_1.values()), rows, records)


@table
def paper_images(records: Records) -> str:
    """The paper's Table 2: one and several images."""
    conditions = {
        "1 image": "bid, 1 image, wide 1",
        "8 images": "bid, 8 images, wide 1",
        "8 images, wide": "bid, 8 images, wide 2",
    }
    sizes = ("0.9", "1.7", "3.4")
    rows = []
    for title, condition in conditions.items():
        row = [title]
        for size in sizes:
            paper = records["table2_blender_lego"]["paper_percent"][title][size]
            row.append(
                f"{paper:.0f} %; {_successes(records, 'table2_blender_lego', condition, f'bid {size}')}"
            )
        rows.append((*row, _successes(records, "table2_blender_lego", condition, within="1deg 0.02")))
    head = ("images", *(f"start {size} away: paper; here" for size in sizes), "all sizes, within 1°, 0.02")
    return _table(head, rows, records)


@table
def paper_inerf(records: Records) -> str:
    """The paper's comparison with iNeRF."""
    paper = records["inerf_blender_lego"]["paper_percent"]
    said = {
        "bid": f"{paper['bid']:.0f} %",
        "inerf": f"{paper['inerf, translation']:.0f} %, {paper['inerf, rotation']:.0f} %",
    }
    criteria = {
        "5deg 0.05": "within 5°, 0.05",
        "1deg 0.02": "within 1°, 0.02",
        "10%": "10 % of the start's error",
    }
    rows = [
        (f"`{m}`", said[m], *(_successes(records, "inerf_blender_lego", m, "inerf", c) for c in criteria))
        for m in said
    ]
    return _table(("method", "paper", *criteria.values()), rows, records)


@table
def schedule(records: Records) -> str:
    """What the paper leaves open: learning rate, frame of the updates, scale of the Huber loss."""
    rows = []
    for pivot in ("scene", "camera"):
        for rate, scale in (("0.02", "0.1"), ("0.01", "0.1"), ("0.02", "1")):
            condition = f"bid, colour scale {scale}, depth scale {scale}, learning rate {rate}, pivot {pivot}"
            found = (
                _successes(records, "bid_schedule_blender_lego", condition, within=c)
                for c in ("10%", "5deg 0.05")
            )
            rows.append((f"`{pivot}`", rate, scale, *found))
    head = ("`pivot`", "learning rate", "Huber scale", "10 % of the start's error", "within 5°, 0.05")
    return _table(head, rows, records)


@table
def basin(records: Records) -> str:
    """Settings of ``bid`` that may widen the basin of convergence."""
    neutral = {"blur": "0", "box weight": "0", "candidates": "1", "free space weight": "0", "opacity weight": "0",
               "samples": "0", "wide": "1"}  # fmt: skip
    variants: list[dict[str, str]] = [
        {}, {"wide": "2"}, {"opacity weight": "0.3"}, {"free space weight": "1"},
        {"candidates": "3"}, {"box weight": "1"}, {"box weight": "1", "candidates": "3"},
    ]  # fmt: skip
    name, sizes = "bid_reach_blender_lego", ("0.9", "1.7", "3.4")
    rows = []
    for variant in variants:
        condition = "bid, " + ", ".join(f"{key} {value}" for key, value in {**neutral, **variant}.items())
        title = ", ".join(f"`{key.replace(' ', '_')}` {value}" for key, value in variant.items())
        found = (_successes(records, name, condition, f"bid {size}", "5deg 0.05") for size in sizes)
        rows.append(
            (
                title or "the paper's objective",
                *found,
                _successes(records, name, condition, within="1deg 0.02"),
            )
        )
    head = ("settings", *(f"start {size} away" for size in sizes), "all sizes, within 1°, 0.02")
    return _table(head, rows, records)


@table
def imported(records: Records) -> str:
    """A map of weights that others trained."""
    result = records["imported_weights_lego"]
    quality = result["image_quality"]
    rows = []
    for name, cell in result["cells"].items():
        level, sensor = name.split()
        found = (_of(cell[c]) for c in ("5deg 0.05", "1deg 0.02"))
        rows.append((level, sensor, _decibels(quality[level]["psnr_mean_dB"]), *found))
    head = ("level", "input", "PSNR of the level", "within 5°, 0.05", "within 1°, 0.02")
    return _table(head, rows, records)


@table
def photos(records: Records) -> str:
    """Maps from photos whose poses are unknown, beside maps from the poses of the datasets."""
    names = {"photos_doll": "doll", "photos_tum_video": "TUM, as a video", "photos_corridor": "corridor"}
    rows = []
    for name, title in names.items():
        result = records[name]
        poses, found, given = result["poses"], result["localized"]["found"], result["localized"]["given"]
        errors = f"{_length(poses['translation']['median'])}, {poses['rotation_deg']['median']:.2f}°"
        placed = f"{result['placed']} of {result['photos']}"
        rows.append(
            (title, placed, errors, *(_of(found[c]) for c in LIMITS), *(_of(given[c]) for c in LIMITS))
        )
    ways = [f"{whose} poses: {limits}" for whose in ("found", "given") for limits in LIMITS.values()]
    return _table(("scene", "placed", "median error of found poses", *ways), rows, records)


LIMITS = {"5deg 0.05": "within 5°, 0.05", "1deg 0.02": "within 1°, 0.02"}


@table
def service(records: Records) -> str:
    """The service under load, and while its workers are killed."""
    result = records["service"]
    records.used["service"] |= result["load"].get("run", {})  # its parts may have run on different commits
    levels = {f"{level['clients']} clients": level for level in result["load"]["levels"]}
    levels["1 client"] = levels.pop("1 clients")
    levels["4 clients, while workers are killed"] = result["kills"]
    rows = []
    for title, level in sorted(levels.items(), key=lambda item: (item[1]["clients"], item[0])):
        taken = (f"{level['latency_seconds'][of]:.2f} s" for of in ("p50", "p95", "p99"))
        memory = level.get("memory_MiB")
        grown = "" if memory is None else f"{memory['after'] - memory['before']:+.0f} MiB"
        rows.append((title, str(level["requests"]), str(level["identical"]), *taken, grown))
    head = ("load", "requests", "answered as by `localize`", "p50", "p95", "p99", "memory")
    return _table(head, rows, records)


@table
def viewer(records: Records) -> str:
    """How soon the viewer draws maps, and how quickly it answers while photos are localized."""
    maps = {
        "viewer_demo": "demo",
        "viewer_lego": "Lego",
        "viewer": "room",
        "viewer_tum": "TUM",
        "viewer_corridor": "corridor",
    }
    rows = []
    for name, title in maps.items():
        result = records[name]
        usual, longest = result["median"], max(each["largest_ms"] for each in result["rounds"])
        rows.append(
            (
                title,
                f"{result['surfels']:,}",
                f"{usual['first_picture_seconds']:.1f} s",
                f"{usual['frames_a_second']:.0f}",
                f"{usual['median_ms']:.1f} / {longest:.0f} ms",
                f"{result['server_mebibytes_added']:.0f} / {usual['page_mebibytes']:.0f} MiB",
            )
        )
    head = (
        "map",
        "surfels",
        "first picture",
        "frames a second",
        "answers, median / longest",
        "memory, server / page",
    )
    return _table(head, rows, records)


@table
def masks(records: Records) -> str:
    """A person in half of the images, with and without masks."""
    result = records["masks"]
    rows = []
    for scene, ways in result.items():
        if isinstance(ways, dict):
            rows += [(scene, way, *_with_person(found)) for way, found in ways.items()]
    head = (
        "scene",
        "training images",
        "PSNR",
        "landmarks",
        "of these on the person",
        "right",
        "right, queries with the person",
    )
    return _table(head, rows, records)


def _with_person(found: Record) -> Iterator[str]:
    yield _decibels(found["psnr"])
    yield str(found["landmarks"])
    yield str(found["on_person"])
    yield _of(found["as they are"]["5deg 0.05"])
    yield _of(found["with person"]["5deg 0.05"])


@table
def scans(records: Records) -> str:
    """Fused depth as a map, beside registration with the same cloud."""
    names = {"room_living": "room", "tum_fr1_xyz": "TUM"}
    rows = []
    for scene, ways in records["scans"]["scenes"].items():
        for way, cell in ways.items():
            accepted = "-" if cell["accepted"] is None else f"{cell['accepted']}, wrong {cell['silent']}"
            seconds = _seconds(cell["median_cpu_seconds"])
            rows.append((names[scene], way, *(_of(cell[c]) for c in LIMITS), accepted, seconds))
    return _table(("scene", "method", *LIMITS.values(), "accepted", "CPU time"), rows, records)


@table
def splats(records: Records) -> str:
    """Splats that were trained here, beside hash grids."""
    rows = []
    for scene, found in records["splats"]["scenes"].items():
        times = found["step_of_2048_rays"]["median_ms"]
        for name, measured in found["maps"].items():
            right = (_of(ways[name]["5deg 0.05"]) for ways in found["answers"].values())
            silent = sum(ways[name]["silent"] for ways in found["answers"].values())
            quality = (measured["steps"], _decibels(measured["psnr_mean_dB"]))
            size = f"{measured['weights_MB']:.1f} MB"
            rows.append((SCENES[scene], f"`{name}`", *quality, size, f"{times[name]:.0f} ms", *right, silent))
    head = (
        "scene",
        "backend",
        "steps",
        "PSNR",
        "weights",
        "a step of 2048 rays",
        "RGB: right",
        "RGB-D: right",
    )
    return _table((*head, "accepted but wrong"), rows, records)


@table
def splats_from_starts(records: Records) -> str:
    """Methods that need a start, in splats and in hash grids."""
    rows = []
    for scene, found in records["splats"]["scenes"].items():
        for method, ways in found.get("from_starts", {}).items():
            for mode in MODES:
                for name, cell in ways[mode].items():
                    accepted = f"{cell['converged']}, wrong {cell['silent']}"
                    seconds = _seconds(cell["median_cpu_seconds"])
                    right = (_of(cell[c]) for c in LIMITS)
                    rows.append((SCENES[scene], f"`{method}`", mode, f"`{name}`", *right, accepted, seconds))
    head = ("scene", "method", "input", "backend", *LIMITS.values(), "accepted", "CPU time")
    return _table(head, rows, records)


MODES = ("RGB", "RGB-D")


@table
def round_trips(records: Records) -> str:
    """Maps beside those that come from their exports."""
    rows = []
    for scene, modes in records["round_trips"]["scenes"].items():
        for mode, ways in modes.items():
            for way, cell in ways.items():
                accepted = f"{cell['converged']}, wrong {cell['silent']}"
                seconds = _seconds(cell["median_cpu_seconds"])
                rows.append((SCENES[scene], mode, way, *(_of(cell[c]) for c in LIMITS), accepted, seconds))
    return _table(("scene", "input", "map", *LIMITS.values(), "accepted", "CPU time"), rows, records)


@table
def capture_size(records: Records) -> str:
    """Memory of captures of many photos of twelve megapixels."""
    sizes = records["capture_size"]["measurements"]
    counts = sorted({int(name.split()[1]) for name in sizes})
    rows = [
        (n, *(f"{sizes[f'{command} {n}'][kind] / 1000:.1f} GB" for command in COMMANDS for kind in MEMORY))
        for n in counts
    ]
    head = ("photos", *(f"`{command}`{what}" for command in COMMANDS for what in MEMORY.values()))
    return _table(head, rows, records)


COMMANDS = ("train", "bake", "localize")
MEMORY = {"resident_MB": "", "anonymous_MB": ", without files"}


@table
def living_maps(records: Records) -> str:
    """A map of 50 photos that is extended by 35 others, beside one of all."""
    ways = {
        "first": "first photos alone",
        "extended": "extended, first photos no longer there",
        "extended_with_data": "extended, first photos there",
        "all": "all at once",
    }
    rows = []
    for scene in records["living_maps"]["extend"].values():
        for way, title in ways.items():
            found = scene["maps"][way]
            right = (f"{found['right'][limits]} of {found['test']}" for limits in LIMITS)
            rows.append((title, found["images"], found["landmarks"], _decibels(found["psnr"]), *right))
    return _table(("map", "photos", "landmarks", "PSNR", *LIMITS.values()), rows, records)


def main() -> None:
    """Rewrite the generated blocks of all pages."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if (new := rendered(text)) != text:
            page.write_text(new, encoding="utf-8")
            print(f"rewrote {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
