"""Tables of results, made from the records in ``benchmarks/results``, so that no figure in the documentation is typed by hand.

A page holds a table between ``<!-- generated: NAME -->`` and ``<!-- end -->``. ``python docs/tables.py`` rewrites all of them, and
the page of all measurements beside the records; a test compares the pages with the records.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

from bidnerf.evaluation import FAULTS
from bidnerf_core.datasets import READERS
from bidnerf_core.registry import list_plugins

ROOT = Path(__file__).parents[1]
RECORDS = ROOT / "benchmarks" / "results"
MEASUREMENTS = RECORDS / "README.md"
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), MEASUREMENTS)
BLOCK = re.compile(r"(<!-- generated: ([a-z-]+) -->\n).*?(<!-- end -->)", re.DOTALL)

SCENES = {
    "blender_lego": "Lego",
    "room_living": "room",
    "tum_fr1_xyz": "TUM",
    "iphone_corridor": "corridor",
    "phone_doll": "doll",
    "blender_mic": "microphone",
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
        groups: dict[str, list[str]] = {}
        for name, record in self.used.items():
            groups.setdefault(origin(record), []).append(f"`{name}`")
        parts = [f"{', '.join(names)} ({made})" for made, names in groups.items()]
        text = f"*Records: {'; '.join(parts)}.*"
        return f"{textwrap.fill(text, 130, break_long_words=False, break_on_hyphens=False)}\n"


def origin(record: Record) -> str:
    """Return the date, the commit and the hardware of a record."""
    date = datetime.fromisoformat(record["date"])
    cpu = re.sub(r"\(R\)| Processor| @.*", "", record["cpu"])
    machine = " ".join(str(record["gpu"]).split()[:2]) if record.get("gpu") else f"{record['cores']} cores of an {cpu}"
    return f"{date.day} {date:%B %Y}, {record['commit'][:7]}; {machine}"


TABLES: dict[str, Callable[[Records], str]] = {}


def table(make: Callable[[Records], str]) -> Callable[[Records], str]:
    """Register a function under its name as a table of the documentation."""
    TABLES[make.__name__.replace("_", "-")] = make
    return make


def render_page(page: str, folder: Path = RECORDS) -> str:
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


# One renderer of all records: each part of a record that has some of these measures is a row.

MEASURES = {
    "images": ("n", "frames", "trials", "tried", "photos", "images", "test", "requests", "pairs"),
    "right": (
        "5deg 0.05",
        "right",
        "right.5deg 0.05",
        "success.5deg 0.05",
        "criteria.5deg 0.05",
        "within 5 degrees, 0.05",
        "5 cm, 5 deg",
    ),
    "within 1°, 0.02": ("1deg 0.02", "strict", "right.1deg 0.02", "success.1deg 0.02", "criteria.1deg 0.02"),
    "within 2 cm, 2°": ("2 cm, 2 deg",),
    "to 10 % of the start": ("success.10%", "criteria.10%", "10%"),
    "accepted": ("accepted", "converged", "believed"),
    "of these wrong": (
        "silent",
        "accepted_but_wrong",
        "converged_but_wrong",
        "wrong_of_accepted",
        "accepted_wrong",
        "wrong",
    ),
    "right but refused": ("right_but_rejected", "right_but_not_converged", "right_lost"),
    "inside the 95 % bound": ("inside", "inside_95_of_converged", "inside_95_of_accepted", "inside_95"),
    "median error": (
        "median_translation",
        "translation_median",
        "errors.raw.translation_median",
        "translation",
        "translation.median",
    ),
    "and angle": (
        "median_rotation_deg",
        "rotation_deg_median",
        "errors.raw.rotation_deg_median",
        "rotation_deg",
        "rotation_deg.median",
    ),
    "calibration error": ("expected_calibration_error",),
    "refused": ("refused",),
    "damaged": ("damaged",),
    "named": ("named",),
    "landmarks": ("landmarks",),
    "surfels": ("surfels",),
    "PSNR, dB": ("psnr_mean_dB", "psnr"),
    "depth error": ("depth_error_median",),
    "steps": ("steps",),
    "identical": ("identical",),
    "cases": ("cases",),
    "sound": ("sound",),
    "CPU time, s": ("median_cpu_seconds", "median_s", "cpu_seconds", "matching_cpu_seconds", "index_cpu_seconds"),
    "slowest, s": ("slowest_cpu_seconds", "slowest_s", "slowest_seconds", "latency_seconds.p95"),
    "time, s": ("seconds", "training.seconds", "train_seconds", "median.first_picture_seconds", "seconds undisturbed"),
    "frames a second": ("median.frames_a_second", "per_second"),
    "time, ms": ("cpu_ms.median", "graph_ms", "ms", "ms_per_step", "milliseconds_per_step"),
    "as launched, ms": ("launched_ms",),
    "memory": ("peak_resident_GiB", "training.peak_resident_GiB", "resident_MB", "megabytes"),
}
"""The columns of the page of all measurements, and the names that records have for each."""
INNER = {
    "cells",
    "scenes",
    "counts",
    "peers",
    "methods",
    "maps",
    "variants",
    "measurements",
    "starts",
    "summary",
    "extend",
    "levels",
    "load",
    "localized",
    "answers",
    "from_starts",
    "held_out",
    "problems",
    "by_scene",
    "wrong",
    "rows",
    "sizes",
}
"""Names in records that say nothing of what was measured."""
ASIDE = {
    "settings",
    "common_settings",
    "config",
    "versions",
    "map",
    "localization_map",
    "run",
    "pairs",
    "rounds",
    "paper_percent",
    "right",
    "success",
    "criteria",
    "errors",
    "median",
}
"""Parts of records that hold no measurements."""
NAMES = ("scene", "start", "condition", "clients", "title", "level")
"""What tells the elements of a list apart."""


@table
def measurements(records: Records) -> str:
    """All records, by the script that made them."""
    shows = dict(
        re.findall(
            r"^\| `(\w+)` \| (.*?) \|",
            (RECORDS.parent / "README.md").read_text(encoding="utf-8"),
            re.MULTILINE,
        )
    )
    text = ""
    for path in sorted(records.folder.glob("*.json")):
        records[path.stem]
        record = records.used.pop(path.stem)
        script = re.sub(r".*?(\w+)\.py.*", r"\1", record["command"])
        rows = list(_measures_of(record["results"], ()))
        columns = [name for name in MEASURES if any(name in cells for _, cells in rows)]
        what = f"{shows[script][0].upper()}{shows[script][1:]}.\n" if script in shows else ""
        text += f"\n## {path.stem}\n\n{what}{'' if not what else chr(10)}*{origin(record)}: `{record['command']}`*\n"
        if columns:
            text += "\n" + _lines(
                ("", *columns), ((name, *(cells.get(c, "") for c in columns)) for name, cells in rows)
            )
    return text.lstrip("\n")


def _measures_of(node: Any, path: tuple[str, ...]) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the name and the measures of each part of a record that has any two of them."""
    if isinstance(node, list):
        for number, child in enumerate(node):
            if isinstance(child, dict):
                own = [
                    f"{child[k]} {k}" if k == "clients" else _in_words(str(child[k]))
                    for k in NAMES
                    if isinstance(child.get(k), (str, int))
                ]
                yield from _measures_of(child, (*path, ", ".join(own) or str(number + 1)))
        return
    cells = {}
    for column, keys in MEASURES.items():
        values = (_inside(node, key) for key in keys)
        if shown := next((text for value in values if (text := _shown_value(value))), ""):
            cells[column] = shown
    if len(cells) > 1:
        yield ", ".join(path), cells
    for key, child in node.items():
        if isinstance(child, (dict, list)) and key not in ASIDE and not _shown_value(child):
            yield from _measures_of(child, path if key in INNER else (*path, _fault_label(_in_words(key))))


def _in_words(key: str) -> str:
    """Return the name of a part of a record in words."""
    for name, title in SCENES.items():
        key = key.replace(name, title)
    return key.replace("_", " ")


def _inside(node: Any, path: str) -> Any:
    """Return what is at a path within a part of a record; None if there is nothing. Keys may hold dots: the whole path comes first."""
    if not isinstance(node, dict):
        return None
    if path in node:
        return node[path]
    first, _, rest = path.partition(".")
    return _inside(node.get(first), rest) if rest else None


def _shown_value(value: Any) -> str:
    """Return a number, a rate or a count of a record as text; empty for anything else."""
    if isinstance(value, bool) or value is None:
        return ""
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    if isinstance(value, str):
        return value if re.fullmatch(r"\d+ of \d+", value) else ""
    counts = isinstance(value, list) and len(value) == 2 and all(isinstance(x, int) for x in value)
    if counts or (isinstance(value, dict) and ("rate" in value or {"successes", "trials"} <= value.keys())):
        return _of(value)
    return str(len(value)) if isinstance(value, list) and all(isinstance(x, str) for x in value) and value else ""


def _seconds(value: float) -> str:
    return f"{value:.2g} s"


def _length(value: float) -> str:
    return f"{value:.4f}" if value < 0.01 else f"{value:.3f}"


def _of(rate: Any) -> str:
    """Return a count of a record, ``[successes, trials]`` or with intervals and steps, as "successes of trials"."""
    if isinstance(rate, list):
        return f"{rate[0]} of {rate[1]}"
    rate = rate.get("rate", rate)
    return f"{rate['successes']} of {rate['trials']}"


def _fault_label(name: str) -> str:
    """Return faults as ``--fault`` takes them, without the size of those that are just on or off."""
    parts = (part.partition(":") for part in name.split("+"))
    return "+".join(
        kind if kind in FAULTS and FAULTS[kind].is_switch else kind + mark + size for kind, mark, size in parts
    )


# The README and the page of results


def _cells(
    records: Records, name: str, condition: str, where: Callable[[str], bool]
) -> Iterator[tuple[str, str, Record]]:
    """Yield the map, the input and the counts of each cell of a record of answers under a condition, of the maps ``where``."""
    for key, conditions in records[name]["counts"].items():
        scene, _, sensor = key.partition(", ")
        if condition in conditions and where(scene):
            yield scene, sensor, conditions[condition]


def _sum(cells: Iterable[Record]) -> Record:
    """Return the sums of counts of a record of answers."""
    every = list(cells)
    sums: Record = {key: sum(cell[key] for cell in every) for key in ("n", "right", "strict", "accepted", "silent")}
    return sums | {"inside": [sum(cell["inside"][part] for cell in every) for part in (0, 1)]}


@table
def headline(records: Records) -> str:
    """README's sentence about localization without a start, in maps of all training images."""
    cells = list(_cells(records, "answers_unchanged", "all", lambda name: name in SCENES))
    counts, scenes = {}, {}
    for sensor in ("RGB", "RGB-D"):
        some = [cell for _, which, cell in cells if which == sensor]
        counts[sensor], scenes[sensor] = _sum(some), len(some)
    every, (rgb, rgbd) = _sum(cell for _, _, cell in cells), counts.values()
    wrong, times = every["silent"], [cell["median_s"] for _, _, cell in cells]
    text = (
        f"Without a start, it localizes {rgb['right']} of {rgb['n']} held-out RGB images of {scenes['RGB']} scenes and"
        f" {rgbd['right']} of {rgbd['n']} RGB-D images of {scenes['RGB-D']} scenes to within 5 degrees and 0.05 metres (or the unit of the map). It accepts"
        f" {every['accepted']} of these poses, of which {wrong or 'none'} {'is' if wrong < 2 else 'are'} wrong. An image takes"
        f" {min(times):.1f} to {max(times):.1f} seconds of CPU time (median of a scene)."
    )
    return f"{textwrap.fill(text, 118)}\n\n{records.caption()}"


PEERS = {
    "auto": "`auto`",
    "sift + pnp (pycolmap)": "SIFT, PnP (pycolmap)",
    "open3d fpfh + ransac + icp": "RANSAC, ICP (Open3D)",
}


@table
def peers(records: Records) -> str:
    """Method ``auto`` beside SIFT with PnP on RGB images, and beside ICP on the depth of RGB-D images, all without a start."""
    rows = [
        (
            SCENES[scene],
            images,
            title,
            _of(found[name]["5deg 0.05"]),
            _of(found[name]["1deg 0.02"]),
            _length(found[name]["median_translation"]),
            "" if found[name]["accepted"] is None else f"{found[name]['accepted']}, {found[name]['silent']} wrong",
            _seconds(found[name]["median_cpu_seconds"]),
        )
        for images in ("RGB", "RGB-D")
        for scene, modes in records["landmark_peers"]["scenes"].items()
        if images in modes and len(found := modes[images]["peers"]) > 1
        for name, title in PEERS.items()
        if name in found
    ]
    head = ("scene", "images", "method", "within 5°, 0.05", "within 1°, 0.02", "median error", "accepted", "CPU time")
    return _table(head, rows, records)


@table
def field_helps(records: Records) -> str:
    """Landmarks alone beside all terms, on RGB images, by scene."""
    rows = []
    for scene, found in records["auto_terms"].items():
        ways = [found["variants"][f"RGB, {way}"] for way in ("landmarks alone", "all")]
        pairs = [(_of(w["5deg 0.05"]), _of(w["1deg 0.02"]), _length(w["median_translation"])) for w in ways]
        rows.append((SCENES[scene], *(" / ".join(pair) for pair in zip(*pairs, strict=True))))
    return _table(("scene", "within 5°, 0.05", "within 1°, 0.02", "median error"), rows, records)


@table
def training_times(records: Records) -> str:
    """A sentence about what ``bidnerf train`` takes with and without ``--quick``."""
    scenes = records["quick_maps"]["quick"].values()
    minutes, photos = (sorted(scene[key] for scene in scenes) for key in ("cpu_minutes", "photos"))
    answers = [both for scene in scenes for both in scene["answers"].values()]
    quick, more, n = (
        sum(both[which][key] for both in answers)
        for which, key in (("quick", "right"), ("default", "right"), ("quick", "n"))
    )
    text = (
        f"`--quick` took {minutes[0]:.1f} to {minutes[-1]:.1f} minutes of CPU time for {len(scenes)} scenes of {photos[0]} to {photos[-1]} images,"
        f" without a GPU; its maps find {quick} of {n} held-out images, maps of 1,500 default steps {more}."
    )
    for name, scene in records["quick_maps"]["default"].items():
        text += f" All {scene['steps']:,} steps of the default settings took {scene['cpu_minutes']:.0f} minutes ({SCENES[name]})."
    return f"{textwrap.fill(text, 118)}\n\n{records.caption()}"


@table
def other_answers(records: Records) -> str:
    """Answers to images, in maps, that no bound and no confidence was fitted to; both inputs of a scene together."""
    rows = []
    for name, title in SCENES.items():
        scene = f"{name}@new"
        rows.append(
            (title, _sum(c for _, _, c in _cells(records, "answers_new", "all", lambda key, s=scene: key == s)))
        )
    for sensor in ("RGB", "RGB-D"):
        every = _cells(records, "answers_new", "all", lambda key: key != "all")
        rows.append((f"all, {sensor}", _sum(cell for _, which, cell in every if which == sensor)))
    cells = [
        (title, c["n"], c["right"], c["strict"], c["accepted"], c["silent"], f"{c['inside'][0]}/{c['inside'][1]}")
        for title, c in rows
    ]
    head = ("scene", "answers", "right", "within 1°, 0.02", "accepted", "of these wrong", "inside the 95 % bound")
    return _table(head, cells, records)


@table
def several_maps(records: Records) -> str:
    """Unchanged images on four maps of each scene, of which three are trained from halves of the training images."""
    maps = dict[tuple[str, str], list[dict[str, Any]]]()
    for name, sensor, cell in _cells(records, "answers_unchanged", "all", lambda key: key != "all"):
        maps.setdefault((SCENES[name.partition("@")[0]], sensor), []).append(cell)
    rows = []
    for (scene, sensor), cells in maps.items():
        c = _sum(cells)
        least = min((cell["accepted"] - cell["silent"]) / cell["right"] for cell in cells)
        inside = f"{c['inside'][0]}/{c['inside'][1]}"
        counts = (c["n"], c["right"], c["strict"], c["accepted"], c["silent"])
        rows.append((scene, sensor, *counts, f"{least:.0%}", inside))
    head = ("scene", "input", "answers", "right", "within 1°, 0.02", "accepted", "of these wrong")
    return _table((*head, "right ones accepted, least of the maps", "inside the 95 % bound"), rows, records)


UNKNOWN = {
    "other scene": "another scene",
    "plain wall": "a plain wall",
    "twice": "a scene present twice",
    "twice, start 5 deg": "a scene present twice, with a start near one copy",
}


@table
def unknown(records: Records) -> str:
    """Images to which no answer is right, or more than one."""
    rows = []
    for condition, title in UNKNOWN.items():
        for sensor in ("RGB", "RGB-D"):
            every = _cells(records, "answers_new", condition, lambda key: key == "all")
            c = _sum(cell for _, which, cell in every if which == sensor)
            rows.append((f"{sensor}, {title}", c["n"], c["accepted"], c["silent"]))
    return _table(("images", "number", "accepted", "of these wrong"), rows, records)


@table
def tracking(records: Records) -> str:
    """The tracker on two sequences, beside generalised ICP."""
    rows = []
    for scene in ("tum_fr1_xyz", "iphone_corridor"):
        runs = records["tracking"][scene]
        for name in ("RGB, in order", "RGB-D, in order", "RGB-D, GICP from the last pose"):
            if (run := runs.get(name)) is not None:
                raw, way = (
                    run["errors"]["raw"],
                    "GICP from the last pose (small_gicp)" if "GICP" in name else "tracker",
                )
                rows.append(
                    (
                        f"{SCENES[scene]}, {name.partition(',')[0]}",
                        way,
                        f"{run['accepted']} of {run['frames']}",
                        run["accepted_but_wrong"],
                        f"{_length(raw['translation_median'])} m, {raw['rotation_deg_median']:.2f}°",
                        f"{run['cpu_ms']['median']:.0f} ms",
                    )
                )
    return _table(("sequence", "method", "accepted", "of these wrong", "median error", "CPU per frame"), rows, records)


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
def formats(_: Records) -> str:
    """The formats of datasets, as their readers describe them."""
    readers = {info.name: READERS[info.name] for info in list_plugins("readers") if info.is_bundled}
    rows = [(f"`{name}`", reader.summary, reader.expected) for name, reader in readers.items()]
    return _lines(("reader", "format", "recognized by"), rows)


@table
def pose_files(_: Records) -> str:
    """The formats of pose files, by the ending of the file's name."""
    bundled = [info for info in list_plugins("writers") if info.is_bundled]
    rows = [(f"`{info.name}`", info.summary.rstrip(".")) for info in bundled]
    return _lines(("name ends with", "content"), rows)


@table
def risk(records: Records) -> str:
    """What a stated risk is worth: the share of wrong answers among the accepted ones, and how many right ones it costs."""
    record = records["risk"]

    def counted(found: Record) -> str:
        return f"{found['wrong']} of {found['accepted']}"

    rows = []
    for risk, halves in record["other_halves"].items():
        tested, scenes = record["other_faults"], record["scene_left_out"]
        worst = max(scenes, key=lambda scene: scenes[scene][risk]["wrong"] / max(scenes[scene][risk]["accepted"], 1))
        if halves["halves_with_a_threshold"]:
            rows.append(
                (
                    f"{float(risk):.1%}",
                    counted(tested[risk]),
                    f"{tested[risk]['right_lost']} of {tested['right']}",
                    f"{halves['exceeded']} of {halves['halves_with_a_threshold']}",
                    f"{counted(scenes[worst][risk])} ({SCENES[worst.partition('@')[0]]})",
                )
            )
    head = (
        "stated risk",
        "other faults: wrong of accepted",
        "right answers lost",
        "halves in which the risk is exceeded",
        "worst scene when left out: wrong of accepted",
    )
    return _table(head, rows, records)


@table
def gpu(records: Records) -> str:
    """What a GPU takes."""
    found, rows = dict(records["gpu"]) | dict(records["gpu_queries"]), []
    for scene, levels in found["steps"].items():
        for level, m in levels.items():
            coarse = "coarse level" if level == "level 0" and len(levels) > 1 else "full detail"
            rows.append(
                (
                    f"step of `bid` with {found['rays']} rays, {coarse}",
                    SCENES[scene],
                    f"{m['graph_ms']:.2f} ms",
                    f"{m['launched_ms']:.1f} ms one by one",
                )
            )
    for scene, sizes in found["search"].items():
        for size, m in sizes.items():
            rows.append((f"5 Gauss-Newton steps of {size}", SCENES[scene], f"{m['ms']:.1f} ms", ""))
    for scene, modes in found["queries"].items():
        for mode, m in modes.items():
            same = f"right {m['right']} of {m['frames']}, on the CPU {m['right_on_cpu']}"
            rows.append((f"query without a start, {mode}", SCENES[scene], f"{m['ms']:.0f} ms", same))
    for scene, m in found["training"].items():
        rest = f"{m['steps']} steps of {m['ms_a_step']:.1f} ms after {m['seconds_before_first_steps']:.0f} s"
        rows.append((f"training to {m['psnr']:.1f} dB", SCENES[scene], f"{m['seconds']:.0f} s", rest))
    for scene, m in found["kernel"].items():
        rest = f"{m['share']:.0%} of what its reads allow"
        rows.append((f"hash grid with derivatives, {m['points']} points", SCENES[scene], f"{m['ms']:.1f} ms", rest))
    return _table(("what", "map", "time", ""), rows, records)


# Large maps


def _sizes(records: Records, unit: str) -> Iterator[tuple[str, Record]]:
    """Yield the results of each size of a map, such as ``100,000 landmarks``."""
    for title, found in records["large"].items():
        if re.fullmatch(rf"[\d,]+ {unit}", title):
            yield title, found


@table
def large_queries(records: Records) -> str:
    """Queries of a scene among distractors."""
    rows = []
    copies = [(title, found) for title, found in records["large"].items() if title.endswith("times there")]
    for title, found in [*_sizes(records, "landmarks"), *copies]:
        name = f"{found['landmarks']:,}" + (f", the scene {title.removesuffix(' there')}" if "there" in title else "")
        rows.append(
            (
                name,
                f"{found['right']} of {found['n']}",
                found["accepted"],
                found["silent"],
                _seconds(found["median_cpu_seconds"]),
                f"{found['opened_cpu_seconds']:.1f} s",
                f"{found['memory_MB']:.0f} MB",
            )
        )
    head = ("landmarks", "right", "accepted", "of these wrong", "CPU time of a query", "opened in", "memory")
    return _table(head, rows, records)


@table
def large_buildings(records: Records) -> str:
    """What the landmarks of a building take, by the number of its photos, and the exponents of growth."""
    rows = []
    for title, found in _sizes(records, "photos"):
        steps = [f"{found['steps'][step]['cpu_seconds']:.1f} s" for step in STEPS]
        whole, memory = f"{found['cpu_seconds_a_photo']:.3f} s", f"{found['most_memory_MB'] / 1e3:.1f} GB"
        rows.append((title.removesuffix(" photos"), *steps, whole, memory, f"{found['map_MB']:.0f} MB"))
    grown = records["large"]["exponents"]
    rows.append(("exponent", *(f"{grown[step]:.2f}" for step in (*STEPS, "all", "memory")), ""))
    head = ("photos", *STEPS, "a photo", "most memory", "map")
    return _table(head, rows, records)


STEPS = ("pairs", "matches and tracks", "landmarks", "trial")
"""The steps in which landmarks are made."""


@table
def large_answers(records: Records) -> str:
    """Answers to new photos of the building, in one map, and in many maps at once."""
    rows = []

    def row(title: str, found: Record) -> None:
        right = f"{found['right']} of {found['n']}"
        time = _seconds(found["median_cpu_seconds"])
        rows.append((title, right, found["accepted"], found["silent"], time))

    for title, found in records["large"].items():
        if title.endswith(" photos, asked"):
            row(f"one map of {title.removesuffix(', asked')}", found)
    for title, found in records["large"].items():
        if title.endswith(" maps"):
            row(f"{title} of 6,400 photos, all at once", found["together"])
            row("of these, the one that the photo shows", found["alone"])
    return _table(("map", "right", "accepted", "of these wrong", "CPU time of a query"), rows, records)


@table
def large_projection(records: Records) -> str:
    """What a million photos would take, if each further one took as much as those between the two largest sizes."""
    *_, (_, former), (title, last) = _sizes(records, "photos")

    def projected(value: Callable[[Record], float]) -> float:
        each = (value(last) - value(former)) / (last["photos"] - former["photos"])
        return value(last) + each * (1_000_000 - last["photos"])

    rows = []
    for step in STEPS[:-1]:  # a trial asks for 24 photos of any number
        minutes = projected(lambda found, step=step: found["steps"][step]["cpu_seconds"]) / 60  # type: ignore[misc]
        rows.append((step, f"{minutes / 60:.1f} h" if minutes >= 60 else f"{minutes:.0f} min"))
    for what, name in (("memory of one process", "most_memory_MB"), ("map on disk", "map_MB")):
        rows.append((what, f"{projected(lambda found, name=name: found[name]) / 1e3:,.0f} GB"))  # type: ignore[misc]
    return _table(("a million photos like these, in one map", f"projected from {title}, one core"), rows, records)


@table
def large_photos(records: Records) -> str:
    """What it takes to find the poses of photos that have none, by ``find_poses`` and by COLMAP."""
    ways = {
        "ours": "`bidnerf poses`",
        "cluster": "the same, on a cluster of four processes",
        "killed": "the same, one of them killed",
        "colmap": "COLMAP, all pairs, incremental mapper",
    }
    rows = []
    for scene, found in records["photos_without_poses"].items():
        for way, title in ways.items():
            if (own := found.get(way)) is not None:
                placed = f"{own['placed']} of {own['photos']}"
                rest = [f"{number}" for number in own["models"][1:]]
                error, same = f"{own['error']:.3f} px", {True: "to the bit", False: "no"}.get(own.get("equal"), "")
                rows.append((scene, title, _seconds(own["cpu_seconds_a_photo"]), placed, ", ".join(rest), error, same))
    return _table(
        ("scene", "poses by", "CPU time a photo", "placed", "in other models", "error", "equal to one process"),
        rows,
        records,
    )


@table
def large_posed(records: Records) -> str:
    """What ``train`` does with posed photos before it trains the field."""
    rows = [
        (
            name,
            own["photos"],
            own["pairs"],
            *(f"{own['cpu_seconds_of_stages'][stage] / own['photos']:.2f} s" for stage in PREPARATION),
            f"{own['cpu_seconds_a_photo']:.2f} s",
        )
        for name, found in records["photos_without_poses"].items()
        if (own := found.get("posed")) is not None
    ]
    return _table(("scene", "photos", "pairs", *PREPARATION.values(), "a photo, all"), rows, records)


PREPARATION = {
    "reading": "reading",
    "landmarks": "keypoints and matches",
    "checking poses": "poses and points",
    "trying the landmarks on images": "landmarks and trial",
}
"""The stages before the field, by their names in reports of progress."""


@table
def large_search(records: Records) -> str:
    """Search of descriptors by the map's index and by faiss."""
    found = records["large"]["search"]
    rows = [
        (title, f"{own['build_cpu_seconds']:.0f} s", f"{own['cpu_ms']:.2f} ms", f"{own['nearest_found']:.1%}")
        for key, title in (("ours", "index of a map"), ("faiss", "faiss, `IVF,SQ8_direct`"))
        if (own := found.get(key)) is not None
    ]
    return _table((f"{found['descriptors']:,} descriptors", "built in", "a keypoint", "nearest found"), rows, records)


# The paper's experiments


def _successes(records: Records, name: str, condition: str, start: str = "bid, all sizes", within: str = "10%") -> str:
    """Return the successes in the one cell whose condition has all parts of ``condition``, with Wilson's 95 % interval."""
    parts = set(condition.split(", "))
    cells = [c for c in records[name]["cells"] if parts <= set(c["condition"].split(", ")) and c["start"] == start]
    (cell,) = cells
    rate = cell["success"][within]["rate"]
    return f"{rate['successes']} of {rate['trials']} ({100 * rate['low']:.0f} to {100 * rate['high']:.0f} %)"


@table
def paper_depth(records: Records) -> str:
    """The paper's Table 1: depth and level of detail."""
    rows = []
    for sensor in ("RGB-D", "RGB"):
        for level, name in {"0": "coarse", "none": "fine"}.items():
            paper = records["table1_blender_lego"]["paper_percent"][f"{sensor} {name}"]
            condition = f"bid, {sensor}, level {level}"
            rows.append((f"{sensor}, {name}", f"{paper:.0f} %", _successes(records, "table1_blender_lego", condition)))
    return _table(("compared", "paper", "Lego, `hashgrid`"), rows, records)


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
        (f"`{m}`", said[m], *(_successes(records, "inerf_blender_lego", m, "inerf", c) for c in criteria)) for m in said
    ]
    return _table(("method", "paper", *criteria.values()), rows, records)


def main() -> None:
    """Rewrite the generated blocks of all pages."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if (new := render_page(text)) != text:
            page.write_text(new, encoding="utf-8")
            print(f"rewrote {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
