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
    "kills": ("kills",),
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

CLEAN = {"RGB": "no_start_rgb", "RGB-D": "no_start_rgbd"}
"""Records of method ``auto`` on images without faults."""


@table
def headline(records: Records) -> str:
    """README's sentence about localization without a start."""
    cells = {
        sensor: [scene[sensor]["none"] for scene in records[name]["cells"].values()] for sensor, name in CLEAN.items()
    }
    every = [cell for some in cells.values() for cell in some]
    counts = {sensor: [sum(cell[key] for cell in some) for key in ("right", "n")] for sensor, some in cells.items()}
    accepted, wrong = (sum(cell[key] for cell in every) for key in ("converged", "silent"))
    times = [cell["median_cpu_seconds"] for cell in every]
    (a, b), (c, d) = counts.values()
    text = (
        f"Without a start, it localizes {a} of {b} held-out RGB images of {len(cells['RGB'])} scenes and {c} of {d} RGB-D images of"
        f" {len(cells['RGB-D'])} scenes to within 5 degrees and 0.05 units. It accepts {accepted} of these poses, of which"
        f" {wrong or 'none'} {'is' if wrong < 2 else 'are'} wrong. An image takes {min(times):.1f} to {max(times):.1f} seconds of"
        " CPU time (median of a scene)."
    )
    return f"{textwrap.fill(text, 118)}\n\n{records.caption()}"


@table
def peers(records: Records) -> str:
    """Method ``auto`` beside SIFT with PnP on RGB images, and beside ICP on the depth of RGB-D images, all without a start."""
    names = {"auto": "`auto`", "sift + pnp (pycolmap)": "SIFT, PnP (pycolmap)", "open3d icp": "RANSAC, ICP (Open3D)"}
    measured = [(scene, "RGB", found["RGB"]["peers"]) for scene, found in records["landmark_peers"]["scenes"].items()]
    by_depth = [records[name] for name in ("registration_room", "registration_lego")]
    measured += [(record["data"], "RGB-D", record["methods"]) for record in by_depth]
    rows = [
        (
            SCENES[scene],
            images,
            title,
            _of(found[name]["5deg 0.05"]),
            _of(found[name]["1deg 0.02"]),
            _length(found[name]["median_translation"]),
            f"{found[name]['accepted']}, {found[name]['silent']} wrong" if "accepted" in found[name] else "",
            _seconds(found[name]["median_cpu_seconds"]),
        )
        for scene, images, found in measured
        for name, title in names.items()
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
    """A sentence about what ``bidnerf train`` takes with default settings."""
    names = (
        "map_phone_doll",
        "map_blender_lego",
        "map_room_living",
        "map_tum_fr1_xyz",
        "map_iphone_corridor",
    )
    taken = [records[name]["training"] for name in names]
    times = sorted(round(each["seconds"] / 60) for each in taken)
    memory = sorted(each["peak_resident_GiB"] for each in taken)
    text = (
        f"With default settings, `train` took {times[0]} to {times[-1]} minutes and {memory[0]:.1f} to {memory[-1]:.1f} GiB for each of five"
        " scenes of 85 to 436 images, on two cores without a GPU."
    )
    if (records.folder / "quick_maps.json").exists():
        quick = [scene for scene in records["quick_maps"].values() if isinstance(scene, dict)]
        minutes = sorted(scene["cpu_minutes"] for scene in quick)
        asked = [both for scene in quick for both in scene["answers"].values()]
        right, usual, n = (
            sum(both[which][key] for both in asked)
            for which, key in (("quick", "right"), ("default", "right"), ("quick", "n"))
        )
        text += (
            f" `--quick` took {minutes[0]:.0f} to {minutes[-1]:.0f} minutes of CPU time; its maps find {right} of {n} images,"
            f" maps of 1,500 default steps {usual}."
        )
    return f"{textwrap.fill(text, 118)}\n\n{records.caption()}"


@table
def other_answers(records: Records) -> str:
    """Answers to images, in maps, that no bound and no confidence was fitted to; both inputs of a scene together."""
    keys, sums = ("n", "right", "strict", "accepted", "silent"), dict[str, list[int]]()
    for name, some in records["answers_other_frames"]["counts"].items():
        scene, _, sensor = name.partition(", ")
        if (cell := some.get("all")) is not None and name != "all, all":
            title = f"all, {sensor}" if scene == "all" else SCENES[scene]
            known = sums.get(title, [0] * (len(keys) + 2))
            sums[title] = [a + b for a, b in zip(known, (*(cell[key] for key in keys), *cell["inside"]), strict=True)]
    rows = [(name, *counts[:-2], f"{counts[-2]}/{counts[-1]}") for name, counts in sums.items()]
    head = (
        "scene",
        "answers",
        "right",
        "within 1°, 0.02",
        "accepted",
        "of these wrong",
        "inside the 95 % bound",
    )
    return _table(head, rows, records)


@table
def several_maps(records: Records) -> str:
    """Unchanged images on four maps of each scene, of which three are trained from halves of the training images."""
    maps = dict[tuple[str, str], list[dict[str, Any]]]()
    for name, some in records["answers_unchanged"]["counts"].items():
        scene, _, sensor = name.partition(", ")
        if scene != "all":
            maps.setdefault((SCENES[scene.partition("@")[0]], sensor), []).append(some["all"])
    rows = []
    for (scene, sensor), cells in maps.items():
        sums = [sum(cell[key] for cell in cells) for key in ("n", "right", "strict", "accepted", "silent")]
        inside = "/".join(str(sum(cell["inside"][part] for cell in cells)) for part in (0, 1))
        least = min((cell["accepted"] - cell["silent"]) / cell["right"] for cell in cells)
        rows.append((scene, sensor, *sums, f"{least:.0%}", inside))
    head = ("scene", "input", "answers", "right", "within 1°, 0.02", "accepted", "of these wrong")
    return _table((*head, "right ones accepted, least of the maps", "inside the 95 % bound"), rows, records)


@table
def unknown(records: Records) -> str:
    """Images to which no answer is right, or more than one."""
    rows = []
    for sensor, name in {"RGB": "faults_foreign", "RGB-D": "faults_foreign_rgbd"}.items():
        c = records[name]["all"]
        rows.append((f"{sensor} images of another scene", c["n"], c["converged"], c["silent"]))
    for query, title in {
        "RGB": "RGB, scene present twice",
        "RGB-D": "RGB-D, scene present twice",
        "RGB, start": "RGB, scene present twice, with a start near one copy",
    }.items():
        parts = [records[name]["all"][query] for name in ("repeated_scene", "repeated_scene_lego")]
        n, accepted, right = (sum(part[key] for part in parts) for key in ("n", "believed", "believed and right"))
        rows.append((title, n, accepted, accepted - right))
    return _table(("images", "number", "accepted", "of these wrong"), rows, records)


@table
def tracking(records: Records) -> str:
    """The tracker on two sequences, beside generalised ICP."""
    rows = []
    for record, scene in {"tracking": "tum_fr1_xyz", "tracking_corridor": "iphone_corridor"}.items():
        runs = records[record][scene]
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
def standard_layouts(records: Records) -> str:
    """The standard benchmarks, tried on scenes of ours that were written in their layouts; RGB images."""
    rows = []
    for name, sensors in records["standard_layouts"].items():
        c = sensors["RGB"]
        median = f"{100 * c['median_translation']:.1f} cm, {c['median_rotation_deg']:.2f}°"
        shares = [f"{c[share]:.0%}" for share in ("5 cm, 5 deg", "2 cm, 2 deg")]
        inside = f"{c['inside_95_of_accepted']}/{c['accepted']}"
        rows.append((name, median, *shares, f"{c['accepted']}/{c['n']}", c["wrong_of_accepted"], inside))
    head = (
        "scene, ground truth",
        "median error",
        "5 cm, 5°",
        "2 cm, 2°",
        "accepted",
        "of these wrong",
        "inside the 95 % bound",
    )
    return _table(head, rows, records)


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
                    f"{counted(scenes[worst][risk])} ({SCENES.get(worst, worst)})",
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


# The paper's experiments


def _successes(records: Records, name: str, condition: str, start: str = "bid, all sizes", within: str = "10%") -> str:
    cells = records[name]["cells"]
    (cell,) = [c for c in cells if c["condition"] == condition and c["start"] == start]
    return _of(cell.get("success", cell.get("criteria"))[within])


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
            row.append(f"{paper:.0f} %; {_successes(records, 'table2_blender_lego', condition, f'bid {size}')}")
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
        (f"`{m}`", said[m], *(_successes(records, "inerf_blender_lego", m, "inerf", c) for c in criteria)) for m in said
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
                _successes(records, "bid_schedule_blender_lego", condition, within=c) for c in ("10%", "5deg 0.05")
            )
            rows.append((f"`{pivot}`", rate, scale, *found))
    head = ("`pivot`", "learning rate", "Huber scale", "10 % of the start's error", "within 5°, 0.05")
    return _table(head, rows, records)


@table
def basin(records: Records) -> str:
    """Settings of ``bid`` that may widen the basin of convergence."""
    neutral = {
        "blur": "0",
        "box weight": "0",
        "candidates": "1",
        "free space weight": "0",
        "opacity weight": "0",
        "samples": "0",
        "wide": "1",
    }
    variants: list[dict[str, str]] = [
        {},
        {"wide": "2"},
        {"opacity weight": "0.3"},
        {"free space weight": "1"},
        {"candidates": "3"},
        {"box weight": "1"},
        {"box weight": "1", "candidates": "3"},
    ]
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


def main() -> None:
    """Rewrite the generated blocks of all pages."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if (new := render_page(text)) != text:
            page.write_text(new, encoding="utf-8")
            print(f"rewrote {page.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
