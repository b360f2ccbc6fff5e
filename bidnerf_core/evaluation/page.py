"""The page of a report: one self-contained HTML file, which needs no network."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.evaluation.groups import Group, Situation, situation_titles, situations
from bidnerf_core.evaluation.provenance import Provenance
from bidnerf_core.evaluation.summary import ABSOLUTE, RELATIVE, PairTest, Success, pairwise_tests, summarize
from bidnerf_core.results.errors import CRITERIA
from bidnerf_core.results.plot_style import CRITERION_NAMES

MARK = '<meta name="generator" content="bidnerf report">'
"""The mark of a page as a report, which a later report may replace."""

UNFINISHED = (
    f"<!doctype html>{MARK}<title>Unfinished report</title>"
    "<p>This report was interrupted; the same command writes it again.</p>\n"
)

CSS = """
:root { color-scheme: light; }
body { font: 16px/1.5 Georgia, "Times New Roman", serif; color: #222; background: #fff;
  max-width: 62rem; margin: 3rem auto; padding: 0 1.5rem; }
h1 { font-size: 1.7rem; font-weight: normal; margin: 0 0 .2rem; }
h2 { font-size: 1.2rem; margin: 2.6rem 0 .6rem; }
p { max-width: 44rem; margin: .4rem 0; }
.small { color: #555; font-size: .88rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font: .84rem/1.35 "Helvetica Neue", Arial, sans-serif; width: 100%;
  font-variant-numeric: tabular-nums; border-top: 1.5px solid #222; border-bottom: 1.5px solid #222; margin: .8rem 0; }
th { font-weight: 600; text-align: right; vertical-align: bottom; padding: .35rem .6rem; border-bottom: 1px solid #222; }
td { text-align: right; padding: .28rem .6rem; vertical-align: top; }
th.text, td.text { text-align: left; min-width: 9rem; }
tr.section td { text-align: left; font-weight: 600; padding-top: .8rem; border-top: 1px solid #ccc; }
tr.section:first-child td { border-top: none; padding-top: .4rem; }
td .sub { display: block; color: #666; font-size: .88em; white-space: nowrap; }
td.low { font-weight: 600; }
figure { margin: 1.2rem 0; }
figure img { width: 100%; height: auto; }
figcaption { font-size: .88rem; color: #444; max-width: 48rem; }
pre { font: .78rem/1.45 ui-monospace, "DejaVu Sans Mono", monospace; background: #f6f6f4; padding: .7rem .9rem;
  white-space: pre-wrap; overflow-wrap: anywhere; margin: .4rem 0 .8rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; font-size: .88rem; margin: .4rem 0; }
dt { color: #666; } dd { margin: 0; overflow-wrap: anywhere; }
@media print { body { margin: 0; max-width: none; } h2 { break-after: avoid; } figure { break-inside: avoid; } }
"""


Titles = dict[Situation, str]


@dataclass(frozen=True)
class Figure:
    """A figure of the page, with its caption."""

    file: Path  # SVG
    caption: str


def page(
    title: str,
    groups: Sequence[Group],
    figures: Sequence[Figure],
    runs: Sequence[tuple[str, Sequence[Provenance]]],
    criterion: str,
) -> str:
    """Return the HTML of a report. ``runs`` has the name of each results file and the runs that made it."""
    titles = situation_titles(situations(groups))
    trials = sum(len(g.results) for g in groups if g.situation.size is not None)
    body = [
        f"<h1>{_text(title)}</h1>",
        f'<p class="small">{_opening(groups, trials)}</p>',
        "<h2>Success</h2>",
        _rates(groups, titles),
        _notes(groups),
        *[_figure(figure) for figure in figures],
        "<h2>Speed and accuracy</h2>",
        _costs(groups, titles),
        *_tests(groups, titles, criterion),
        "<h2>How this was made</h2>",
        *[_made(name, known) for name, known in runs],
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"{MARK}"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(title)}</title><style>{CSS}</style></head>\n<body>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
    )


def _opening(groups: Sequence[Group], trials: int) -> str:
    maps = list(dict.fromkeys(_map_name(s) for s in situations(groups)))
    return f"{trials} trials, map{'s' if len(maps) > 1 else ''} {_text('; '.join(maps))}."


def _map_name(s: Situation) -> str:
    return f"{s.map} ({s.weights.partition('.')[0]}) on {s.data}/{s.split}"


def _rates(groups: Sequence[Group], titles: Titles) -> str:
    heads = [("start and method", True), ("n", False), *((CRITERION_NAMES[name], False) for name in CRITERIA)]
    rows = []
    for situation in situations(groups):
        rows.append(_section(titles[situation], 2 + len(CRITERIA)))
        for group in (g for g in groups if g.situation == situation):
            summary = summarize(group.results)
            cells = [_rate(success) for success in summary.criteria.values()]
            rows.append(_row([_text(group.label), str(summary.trials), *cells]))
    return _table(heads, rows)


def _rate(success: Success | None) -> str:
    if success is None:
        return "&ndash;"
    rate = success.rate
    return (
        f"{rate.rate * 100:.1f} %"
        f'<span class="sub">{rate.successes}/{rate.trials}, {rate.low * 100:.0f} to {rate.high * 100:.0f} %</span>'
    )


def _notes(groups: Sequence[Group]) -> str:
    pooled = any(g.situation.size is None for g in groups)
    together = " &ldquo;All sizes&rdquo; pools the trials of all sizes." if pooled else ""
    return (
        '<p class="small">Each cell gives the share of successful trials, their number, and Wilson&rsquo;s 95 % interval. '
        "The translation error is the distance between the camera centres in the map&rsquo;s units (metres in a room); the "
        "rotation error is the geodesic angle. A dash marks a criterion that does not apply: a share of the start&rsquo;s "
        "error needs a start. Settings that all conditions of a method share are not part of their names; each line of the "
        f"results holds all of them.{together}</p>"
    )


def _costs(groups: Sequence[Group], titles: Titles) -> str:
    heads = [
        ("start and method", True),
        *(
            (name, False)
            for name in (
                "translation error", "rotation error", "steps to 10 %", "steps to 5°, 0.05",
                "ms per step", "s per trial", "memory (MiB)", "converged, but wrong", "right, but not converged",
            )
        ),
    ]  # fmt: skip
    rows = []
    for situation in situations(groups):
        rows.append(_section(titles[situation], len(heads)))
        for group in (g for g in groups if g.situation == situation):
            s = summarize(group.results)
            rows.append(
                _row([
                    _text(group.label), _number(s.translation, 4), _number(s.rotation_deg, 2, "°"),
                    _steps(s.criteria[RELATIVE]), _steps(s.criteria[ABSOLUTE]),
                    f"{s.milliseconds_per_step:.1f}", f"{s.seconds:.1f}",
                    f"{s.peak_memory_bytes / 2**20:.0f}", str(s.converged_but_wrong), str(s.right_but_not_converged),
                ])
            )  # fmt: skip
    note = (
        '<p class="small">Errors, steps and times are medians: final errors and times over all trials, steps to success '
        "over the trials that succeeded. Memory is the largest peak of any trial&rsquo;s process. "
        "&ldquo;Converged&rdquo; is the method&rsquo;s own judgement; "
        "&ldquo;right&rdquo; means within 5° and 0.05 units.</p>"
    )
    return _table(heads, rows) + note


def _number(value: float | None, digits: int, unit: str = "") -> str:
    return "&ndash;" if value is None else f"{value:.{digits}f}{unit}"


def _steps(success: Success | None) -> str:
    return "&ndash;" if success is None or success.steps is None else f"{success.steps:g}"


def _tests(groups: Sequence[Group], titles: Titles, criterion: str) -> list[str]:
    found = {
        s: pairwise_tests([g for g in groups if g.situation == s], criterion) for s in situations(groups)
    }
    count = sum(map(len, found.values()))
    if count == 0:
        return []
    heads = [
        ("pair", True), ("successes", False), ("rates: p", False), ("median steps", False),
        ("steps: U", False), ("steps: p", False), ("all trials: p", False),
    ]  # fmt: skip
    rows = []
    for situation, pairs in found.items():
        if pairs:
            rows.append(_section(titles[situation], len(heads)))
            rows += [_pair(pair) for pair in pairs]
    note = (
        f'<p class="small">Success is: {_text(CRITERION_NAMES[criterion])}. Rates are compared with Fisher&rsquo;s '
        "exact test, steps to success with the Mann-Whitney U test (U of the first group) over the trials that succeeded; "
        "&ldquo;all trials&rdquo; repeats it over all trials, with a failure slower than every success. "
        "All tests are two-sided. The p values are not corrected for the number of pairs, "
        f"which is {count}; those under 0.05 are bold.</p>"
    )
    return ["<h2>Differences</h2>", _table(heads, rows), note]


def _pair(pair: PairTest) -> str:
    good = " : ".join(f"{s}/{n}" for s, n in zip(pair.successes, pair.trials, strict=True))
    steps = " : ".join("&ndash;" if s is None else f"{s:g}" for s in pair.median_steps)
    u = "&ndash;" if pair.steps_u is None else f"{pair.steps_u:g}"
    names = f"{_text(pair.first)} <i>against</i> {_text(pair.second)}"
    return _row([names, good, pair.rates_p, steps, u, pair.steps_p, pair.all_p])


def _made(name: str, runs: Sequence[Provenance]) -> str:
    if not runs:
        return f'<p class="small">{_text(name)}: no record of how it was made.</p>'
    last = runs[-1]
    commits = list(dict.fromkeys(_commit(run) for run in runs))
    machines = list(dict.fromkeys(_machine(run) for run in runs))
    versions = ", ".join(f"{k} {v}" for k, v in {**last.versions, "Python": last.python}.items())
    facts = {
        "file": name,
        "began": runs[0].date if len(runs) == 1 else f"{runs[0].date}, last run {last.date}",
        "commit": "; ".join(commits),
        "machine": "; ".join(machines),
        "run by": "; ".join(dict.fromkeys(run.workers for run in runs)),
        "versions": versions,
    }
    listed = "".join(f"<dt>{_text(k)}</dt><dd>{_text(v)}</dd>" for k, v in facts.items())
    commands = "\n".join(dict.fromkeys(run.command for run in runs))
    return f"<dl>{listed}</dl><pre>{_text(commands)}</pre>"


def _commit(run: Provenance) -> str:
    if run.commit is None:
        return "unknown (not run from a checkout)"
    return run.commit + (", with local changes" if run.dirty else "")


def _machine(run: Provenance) -> str:
    memory = "" if run.memory_bytes is None else f", {run.memory_bytes / 2**30:.0f} GiB"
    gpu = "no GPU" if run.gpu is None else run.gpu
    return f"{run.cpu}, {run.cores} cores{memory}, {gpu}, {run.system}"


def _section(title: str, columns: int) -> str:
    return f'<tr class="section"><td colspan="{columns}">{_text(title)}</td></tr>'


def _row(cells: Sequence[str | float | None]) -> str:
    return "<tr>" + "".join(_cell(cell, place == 0) for place, cell in enumerate(cells)) + "</tr>"


def _cell(cell: str | float | None, text: bool) -> str:
    if isinstance(cell, str):
        return f'<td class="text">{cell}</td>' if text else f"<td>{cell}</td>"
    if cell is None:
        return "<td>&ndash;</td>"
    shown = "&lt; 0.001" if cell < 0.001 else f"{cell:.3f}"
    return f'<td class="low">{shown}</td>' if cell < 0.05 else f"<td>{shown}</td>"


def _table(heads: Sequence[tuple[str, bool]], rows: Sequence[str]) -> str:
    top = "".join(
        f'<th class="text">{_text(h)}</th>' if text else f"<th>{_text(h)}</th>" for h, text in heads
    )
    return (
        f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
    )


def _figure(figure: Figure) -> str:
    data = base64.b64encode(figure.file.read_bytes()).decode()
    return (
        f'<figure><img alt="{_text(figure.caption)}" src="data:image/svg+xml;base64,{data}">'
        f"<figcaption>{_text(figure.caption)}</figcaption></figure>"
    )


def _text(words: str) -> str:
    return html.escape(words)
