"""Reports: how results are put side by side, what is said of them, and the page."""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import re
import sys
import warnings
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import Mock

import imageio.v3 as iio
import pytest

import tiny
from bidnerf.cli import main
from bidnerf.evaluation import (
    ResultTable,
    ScalarPoseError,
    Trace,
    Trial,
    TrialResult,
    group_results,
    median,
    note_run,
    provenance,
    script_command,
    summarize,
)

# Inside: groups and figures before they are put on a page
from bidnerf.evaluation.plots import Figures
from bidnerf.evaluation.report import render_page
from bidnerf.evaluation.summary import situation_titles, situations
from bidnerf.results import require_matplotlib, success_rate_by_frame
from bidnerf_core.datasets import DatasetOptions, write_transforms
from bidnerf_core.errors import InputError
from commands import Run, assert_refused
from optional import require
from trial_results import trial_result

STEPS = 10


def result(seed: int, reached: int | None, size: float = 0.5, **settings: Any) -> TrialResult:
    """Return the result of a trial that meets every criterion from step ``reached`` on, if at all."""
    far = STEPS + 1 if reached is None else reached
    moved = [size] * far + [0.001] * (STEPS + 1 - far)
    turned = [12.0] * far + [0.1] * (STEPS + 1 - far)
    protocol, images = settings.pop("protocol", "bid"), settings.pop("images", 1)
    sizes, config = () if protocol == "none" else (size,), json.dumps(settings)
    trial = Trial("house", "photos", ("a",) * images, sizes, seed, protocol=protocol, method="bid", config=config)
    found = trial_result(trial, moved, turned, converged=reached is not None)
    start = None if protocol == "none" else found.start_error
    return dataclasses.replace(found, start_error=start, settings={"rays": 64, "level": 0, **settings})


def write(path: Path, *results: TrialResult) -> Path:
    ResultTable(results).save(path)
    return path


@pytest.fixture
def results() -> list[TrialResult]:
    """Two conditions at two sizes; the second is slower and fails at the larger size."""
    quick = [result(s, 2 + s % 3, size) for size in (1.2, 0.5) for s in range(6)]
    slow = [result(s, None if size > 1 else 6 + s % 4, size, level=None) for size in (0.5, 1.2) for s in range(6)]
    return [*quick, *slow]


def test_groups_are_named_by_what_differs(results: list[TrialResult]) -> None:
    groups = group_results(results)
    assert [g.situation.start for g in groups] == [
        "bid 0.5",
        "bid 0.5",
        "bid 1.2",
        "bid 1.2",
        "bid, all sizes",
        "bid, all sizes",
    ]
    assert {g.label for g in groups} == {"bid, level 0", "bid, level none"}
    assert [len(g.results) for g in groups] == [6, 6, 6, 6, 12, 12]
    assert [g.label for g in group_results(results[:6])] == ["bid"]
    rigs = group_results([result(0, 1), result(0, 1, images=8)])
    assert [g.label for g in rigs] == ["bid, 1 image", "bid, 8 images"]
    blind = result(0, 1)
    blind = dataclasses.replace(blind, trial=dataclasses.replace(blind.trial, depth=False))
    assert [g.label for g in group_results([result(0, 1), blind])] == ["bid, RGB-D", "bid, RGB"]
    other = dataclasses.replace(result(0, 1), weights="weights-2")
    assert len(situations(group_results([result(0, 1), other]))) == 2


def test_a_summary_counts(results: list[TrialResult]) -> None:
    by_name = {(g.situation.start, g.label): summarize(g.results) for g in group_results(results)}
    slow = by_name["bid, all sizes", "bid, level none"]
    judged = require(slow.success["10%"])
    assert (judged.rate.successes, judged.rate.trials) == (6, 12)
    assert judged.rate == success_rate_by_frame([True] * 6 + [False] * 6, [0] * 12)
    assert judged.steps == 7
    assert (slow.ms_per_step, slow.seconds, slow.trials) == (200, 2, 12)
    assert slow.translation == pytest.approx((0.001 + 1.2) / 2)
    assert (slow.converged_but_wrong, slow.right_but_not_converged) == (0, 0)
    lied = dataclasses.replace(result(0, None), converged=True)
    assert summarize([lied]).converged_but_wrong == 1
    busy = [dataclasses.replace(result(seed, 2), seconds=20.0 * seed, cpu_seconds=float(seed)) for seed in (1, 2, 9)]
    assert (summarize(busy).seconds, summarize(busy).cpu_seconds) == (40, 2)  # medians of each


class Page(NamedTuple):
    """What a page would fetch, its pictures, its text, and the names of its tags in order, with a slash where they close."""

    fetched: list[str]
    pictures: list[str]
    text: str
    tags: list[str]


def read(folder: Path) -> Page:
    page = (folder / "index.html").read_text()
    links = re.findall(r'(?:src|href)="([^"]*)"', page)
    pictures = [link for link in links if link.startswith("data:image/svg+xml;base64,")]
    text = html.unescape(re.sub(r"<[^>]*>", "", page))
    return Page([link for link in links if link not in pictures], pictures, text, re.findall(r"<(/?\w+)", page))


@pytest.mark.usefixtures("undrawn")
def test_the_page_needs_nothing_beside_it(
    tmp_path: Path, results: list[TrialResult], capsys: pytest.CaptureFixture[str]
) -> None:
    file = write(tmp_path / "r.jsonl", *results)
    note_run(file, provenance("bidnerf evaluate 'a <map>' photos", "2 local processes"))
    assert main(["report", str(file), "--out", str(tmp_path / "out"), "--title", "Mine & yours"]) == 0
    page = read(tmp_path / "out")
    assert page.fetched == []
    for tag in {*page.tags} - {"meta", "img", "br"}:
        assert page.tags.count(tag) == page.tags.count(f"/{tag}".replace("//", "")), tag
    assert "url(" not in (tmp_path / "out" / "index.html").read_text()
    assert len(page.pictures) == 2
    for picture in page.pictures:
        ET.fromstring(base64.b64decode(picture.partition(",")[2]))
    for said in (
        "Mine & yours",
        "24 trials",
        "bidnerf evaluate 'a <map>' photos",
        "2 local processes",
        "bid, level none",
        "100.0 %6/6 on 1 frame, 21 to 100 %",
        "50.0 %6/12 on 1 frame, 5 to 95 %",
    ):
        assert said in page.text
    for name in ("errors", "convergence"):
        assert (tmp_path / "out" / f"{name}.png").is_file()
    out = capsys.readouterr().out
    assert re.search(r"bid, all sizes\n.*\n  bid, level none +12 +1 +50 % \(5-95\) +50 % \(5-95\) +50 %", out)


def test_a_report_of_one_hopeless_trial_without_a_start(tmp_path: Path) -> None:
    lost = dataclasses.replace(
        result(0, None, protocol="none"), error=None, errors=Trace((None, None), (None, None)), steps=0
    )
    file = write(tmp_path / "r.jsonl", lost)
    assert main(["report", str(file), "--out", str(tmp_path / "out")]) == 0
    assert "no record of how it was made" in read(tmp_path / "out").text


def test_figures_are_the_same_each_time(tmp_path: Path, results: list[TrialResult]) -> None:
    first, second = (Figures(group_results(results[:2]), tmp_path / name, "10%").errors() for name in ("a", "b"))
    assert first[0].read_bytes() == second[0].read_bytes()


@pytest.mark.parametrize(
    ("content", "said"),
    [(None, "no such file"), (b"", "no finished trial"), (b"hello\n", "line 1: not JSON")],
)
def test_a_file_without_results_is_told_in_one_line(
    tmp_path: Path, bidnerf: Run, content: bytes | None, said: str
) -> None:
    file = tmp_path / "r.jsonl"
    if content is not None:
        file.write_bytes(content)
    assert_refused(bidnerf("report", file, "--out", tmp_path / "out"), 1, said)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("undrawn")
def test_a_report_replaces_a_report_and_nothing_else(tmp_path: Path, bidnerf: Run, results: list[TrialResult]) -> None:
    file, out = write(tmp_path / "r.jsonl", *results), tmp_path / "out"
    out.mkdir()  # empty: nothing is lost
    for title in ("first", "second"):
        assert main(["report", str(file), "--out", str(out), "--title", title]) == 0
        assert title in (out / "index.html").read_text()
    for name in ("index.html", "thesis.tex"):
        other = tmp_path / name.partition(".")[0]
        other.mkdir()
        (other / name).write_text("<html>mine</html>")
        refused = bidnerf("report", file, "--out", other)
        assert_refused(refused, 1, f"{other}: holds something other than a bidnerf report")
        assert [path.read_text() for path in other.iterdir()] == ["<html>mine</html>"]


@pytest.mark.usefixtures("undrawn")
def test_an_interrupted_report_is_written_again(
    tmp_path: Path, results: list[TrialResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    file, out = write(tmp_path / "r.jsonl", *results), tmp_path / "out"
    interrupt = Mock(side_effect=KeyboardInterrupt)
    with monkeypatch.context() as patch:
        patch.setattr(Figures, "convergence", interrupt)
        assert main(["report", str(file), "--out", str(out)]) == 130
    assert (out / "errors.png").exists()
    assert main(["report", str(file), "--out", str(out)]) == 0
    assert read(out).fetched == []
    written = (out / "index.html").read_bytes()
    with monkeypatch.context() as patch:  # the page of before stays until the new one is whole
        patch.setattr(Figures, "convergence", interrupt)
        assert main(["report", str(file), "--out", str(out)]) == 130
    assert (out / "index.html").read_bytes() == written


def test_datasets_and_maps_are_named_where_they_differ() -> None:
    first = result(0, 2, protocol="none")
    other = dataclasses.replace(
        first, trial=dataclasses.replace(first.trial, data="scans", images=DatasetOptions(split="val"))
    )
    retrained = dataclasses.replace(first, weights="weights-2.safetensors")
    moved = dataclasses.replace(first, trial=dataclasses.replace(first.trial, map="garden"))

    def titles(*found: TrialResult) -> list[str]:
        return list(situation_titles(situations(group_results(found))).values())

    assert titles(first) == ["no start"]
    assert titles(first, other) == ["photos/test: no start", "scans/val: no start"]
    assert titles(first, moved) == ["house: no start", "garden: no start"]
    assert titles(first, retrained) == ["house (weights-1): no start", "house (weights-2): no start"]
    assert titles(first, dataclasses.replace(other, trial=dataclasses.replace(other.trial, map="garden"))) == [
        "house on photos/test: no start",
        "garden on scans/val: no start",
    ]


@pytest.mark.usefixtures("undrawn")
def test_a_report_without_starts_uses_no_share_of_their_error(tmp_path: Path, bidnerf: Run) -> None:
    free = [result(seed, 2 + seed, protocol="none") for seed in range(3)]
    file, out = write(tmp_path / "r.jsonl", *free), tmp_path / "out"
    assert main(["report", str(file), "--out", str(out)]) == 0
    assert "meet the criterion (under 5° and 0.05 units)" in read(out).text
    assert "at most 10 %" not in read(out).text
    assert_refused(bidnerf("report", file, "--out", out, "--criterion", "10%"), 2, "no trial had a start")
    mixed = write(tmp_path / "m.jsonl", *free, result(0, 2), result(1, 3))
    assert main(["report", str(mixed), "--out", str(out), "--criterion", "10%"]) == 0


@pytest.mark.usefixtures("undrawn")
def test_nothing_is_said_or_drawn_of_steps_that_there_are_not(tmp_path: Path) -> None:
    results = [trial_result(Trial("house", "photos", (f"{n}",), (), n), [0.01 * n], start_error=None) for n in range(4)]
    assert main(["report", str(write(tmp_path / "r.jsonl", *results)), "--out", str(tmp_path / "out")]) == 0
    assert {path.stem for path in (tmp_path / "out").glob("*.svg")} == {"errors"}
    for text in ("ms per step", "steps to", "10 %"):
        assert text not in read(tmp_path / "out").text


@pytest.mark.parametrize(
    ("values", "expected"), [([1, 4], 2.5), ([3, 1, 2], 2), ([1, None], None), ([1, 2, None], 2), ([], None)]
)
def test_a_median_counts_what_is_unknown_as_infinite(values: list[float | None], expected: float | None) -> None:
    assert median(values) == expected


def test_a_damaged_side_file_is_named(tmp_path: Path, bidnerf: Run, results: list[TrialResult]) -> None:
    file = write(tmp_path / "r.jsonl", *results)
    (tmp_path / "r.meta.json").write_text(json.dumps({"runs": 3}))
    assert_refused(bidnerf("report", file, "--out", tmp_path / "out"), 1, "runs is 3, expected a list")


def test_a_recorded_command_has_no_local_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    words = [
        "/a/run.py",
        "map:/data/lego",
        "/b/map:/data/room",
        "--out=/c/d",
        "/e/f",
        "g/h",
        "--size",
        "0.5:10",
    ]
    monkeypatch.setattr(sys, "argv", words)
    assert script_command() == "python run.py map:lego map:room --out=d f g/h --size 0.5:10"


HOSTILE = (
    r"$\frac{$",
    "$x^{y$",
    r"$\badmacro{1}$",
    "$$",
    "\x1b[31mred",
    "nul\0",
    "\x07bell",
    "\u202eesrever",
    "\u2028line",
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "{{ 7 * 7 }}",
    "{% raw %}",
    "a\nb",
    "&amp;",
    "]]>",
    "x" * 5000,
)


def hostile_result(place: int) -> TrialResult:
    """Return a result that holds every second hostile text wherever a file may hold any text."""
    texts, usual = HOSTILE[place::2], result(place, 2 + place, protocol="none")
    text, name = "".join(texts), "".join(texts).replace("\0", "")
    images = DatasetOptions(camera=name, split=text, masks=name)
    trial = dataclasses.replace(usual.trial, map=name, data=name, images=images, device=text)
    return dataclasses.replace(
        usual, settings={each: each for each in texts}, backend=text, weights=text, reason=text, trial=trial
    )


def harmless(text: str) -> bool:
    """Return whether text, apart from line feeds, holds nothing that a terminal or a browser would obey."""
    return all(character.isprintable() or character == "\n" for character in text)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_hostile_names_are_harmless_everywhere(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = write(tmp_path / "r.jsonl", *map(hostile_result, range(2)))
    run = provenance(HOSTILE[4], "\x1b]0;title\x07")
    for text in HOSTILE:
        note_run(file, dataclasses.replace(run, command=text, cpu=text, versions={text: text}))
    title = "<b>\x1b[2J\udcff\u202e$\\frac{$"
    assert main(["report", str(file), "--out", str(tmp_path / "out"), "--title", title]) == 0
    said = capfd.readouterr()
    assert harmless(said.out)
    assert harmless(said.err)
    content = (tmp_path / "out" / "index.html").read_text()
    assert harmless(content)
    for markup in ("<script", "<img src=x", "<b>"):
        assert markup not in content
    page = read(tmp_path / "out")
    assert page.fetched == []
    for shown in (
        r"$\frac{$",
        r"\x1b[31mred",
        r"nul\x00",
        r"\u202eesrever",
        "{{ 7 * 7 }}",
        r"<b>\x1b[2J\udcff",
    ):
        assert shown in page.text
    drawings = list((tmp_path / "out").glob("*.svg"))
    assert len(drawings) == len(page.pictures) == 2
    for drawing in drawings:
        ET.parse(drawing)
        assert iio.imread(drawing.with_suffix(".png")).std() > 1
        assert drawing.stat().st_size > 2000


def test_a_name_that_no_folder_can_have_is_refused(tmp_path: Path, bidnerf: Run) -> None:
    line = json.dumps(result(0, 2).plain())
    for name in ("map", "data", "camera"):
        plain = json.loads(line)
        plain["trial"][name] = "a\0b"
        (tmp_path / "r.jsonl").write_text(json.dumps(plain))
        refused = bidnerf("report", tmp_path / "r.jsonl", "--out", tmp_path / "out")
        assert_refused(refused, 1, f"{name} holds a NUL character")


def test_more_than_can_be_drawn_is_in_the_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bidnerf.evaluation.plots.MOST_SITUATIONS", 1)
    many = [result(seed, 2, protocol="none") for seed in range(8)]
    many = [dataclasses.replace(r, trial=dataclasses.replace(r.trial, map=f"map {r.seed}")) for r in many]
    table = ResultTable(tuple(many))
    figures, whole = (Figures(groups, tmp_path, "5deg 0.05") for groups in (table.groups, table.groups[:1]))
    drawn = [each.errors() for each in (figures, whole)]
    assert ["At most 1 of 8 situations" in caption for _, caption in drawn] == [True, False]
    heights = [iio.imread(path.with_suffix(".png")).shape[0] for path, _ in drawn]
    assert heights[0] == heights[1]
    assert "map 7" in render_page("Many", table, [])


def test_warnings_of_other_libraries_cannot_control_the_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write(tmp_path / "r.jsonl", result(0, 2))

    def warn(self: Figures) -> Path:
        warnings.warn("Glyph \x1b[31m missing", UserWarning, stacklevel=1)
        raise InputError("enough")

    monkeypatch.setattr(Figures, "errors", warn)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *place: print(message, file=sys.stderr)  # type: ignore[assignment]
        assert main(["report", str(file), "--out", str(tmp_path / "out")]) == 1
    said = capfd.readouterr().err
    assert r"Glyph \x1b[31m missing" in said
    assert harmless(said)


@pytest.mark.usefixtures("undrawn")
def test_a_report_links_to_the_frames_from_the_worst_to_the_best(tmp_path: Path) -> None:
    first = trial_result(Trial("house", "photos", ("a",)), [0.1])
    near, far, hostile = ScalarPoseError(0.01, 1.0), ScalarPoseError(0.3, 1.0), "<script>alert(1)</script>"
    rows = [
        dataclasses.replace(first, converged=accepted, error=error, frame=frame, trial=trial)
        for seed, (accepted, error, frame) in enumerate(
            [(False, near, hostile), (True, near, "right"), (True, far, "wrong #1")]
        )
        for trial in [dataclasses.replace(first.trial, seed=seed)]
    ]
    ResultTable(tuple(rows)).save(tmp_path / "results.jsonl")
    (tmp_path / "my map.html").touch()
    report = ["report", str(tmp_path / "results.jsonl"), "--out", str(tmp_path / "out")]
    assert main([*report, "--view", str(tmp_path / "my map.html")]) == 0
    found = (tmp_path / "out" / "index.html").read_text()
    linked = re.findall(r'href="\.\./my%20map\.html#frame=([^"]*)"', found)
    assert linked == ["wrong%20%231", "%3Cscript%3Ealert%281%29%3C/script%3E", "right"]
    assert hostile not in found
    assert main(report) == 0
    assert "my%20map.html" not in (tmp_path / "out" / "index.html").read_text()


@pytest.mark.usefixtures("undrawn")
def test_the_worst_frames_are_shown_as_the_method_received_them(tmp_path: Path) -> None:
    """They are shown with their faults; results name a dataset, of which the reader may have a copy anywhere."""
    views = tiny.views(2)
    write_transforms(tmp_path / "photos", {"train": views, "test": views}, tiny.BACKGROUND)
    names = [view.frame.name for view in views]
    rows = [
        trial_result(Trial("house", data, (name,), fault=fault), [0.01 * n], start_error=None)
        for n, (data, name, fault) in enumerate(
            [("elsewhere", "x", "none"), ("photos", names[0], "exposure:0.01"), ("photos", names[1], "none")]
        )
    ]
    file = write(tmp_path / "r.jsonl", *rows)
    assert main(["report", str(file), "--out", str(tmp_path / "a"), "--data", str(tmp_path / "photos")]) == 0
    found = re.findall(r"data:image/jpeg;base64,([^\"]*)", (tmp_path / "a" / "index.html").read_text())
    bright, black = (iio.imread(base64.b64decode(picture), extension=".jpg") for picture in found)
    assert black.max() < 8 < bright.max()  # the last row is the worst
    assert main(["report", str(file), "--out", str(tmp_path / "b"), "--data", str(tmp_path / "photo")]) == 1
    assert main(["report", str(file), "--out", str(tmp_path / "c")]) == 0
    assert "image/jpeg" not in (tmp_path / "c" / "index.html").read_text()


def test_no_figure_has_more_conditions_or_steps_than_can_be_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bidnerf.evaluation.plots.MOST_CONDITIONS", 3)
    many = [dataclasses.replace(result(seed, 2), method=f"method {seed}") for seed in range(8)]
    trace = Trace((1.0,) * 200_000, (1.0,) * 200_000)
    long = [dataclasses.replace(each, errors=trace, steps=199_999) if each.seed == 1 else each for each in many]
    figures = Figures(ResultTable(tuple(long)).groups, tmp_path, "5deg 0.05")
    drawn = figures.convergence()
    assert drawn is not None
    assert "5 further conditions in the tables are not drawn" in drawn[1]
    assert len(drawn[0].read_bytes()) < 200_000  # every step would take megabytes
    assert [group.label for group in figures.groups] == ["method 0", "method 1", "method 2"]


def test_results_with_faults_are_drawn_beside_those_without(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = [result(seed, 2) for seed in range(3)]
    faulty = [
        dataclasses.replace(each, trial=dataclasses.replace(each.trial, fault=fault))
        for fault in ("blur", "dark")
        for each in plain
    ]
    figures, titles = Figures(group_results([*faulty, *plain]), tmp_path, "5deg 0.05"), list[str]()
    monkeypatch.setattr(figures, "_figure", lambda name, panels, looks, caption: titles.extend(t for t, _ in panels))
    figures.errors()
    starts = list(dict.fromkeys(titles))
    assert [title.rpartition(", ")[2] for title in starts[1:]] == ["blur", "dark"]
    assert "blur" not in starts[0]
    assert len(titles) == 9  # three kinds of curves for each


def test_settings_of_matplotlib_do_not_count(tmp_path: Path) -> None:
    matplotlib = require_matplotlib()
    with matplotlib.rc_context({"text.usetex": True, "figure.dpi": 1e9}):
        figure = Figures(ResultTable((result(0, 2),)).groups, tmp_path, "5deg 0.05").errors()
    assert figure is not None
    assert figure[0].stat().st_size > 1000
