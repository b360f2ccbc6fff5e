"""Every example runs as its first lines say."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest

from bidnerf.evaluation import open_scene
from bidnerf.scenes import closed_form_data, orbit
from bidnerf_bid import DEPTH_RESIDUALS
from bidnerf_core import registry
from commands import quietly

pytestmark = pytest.mark.slow


EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.py"))
QUICK = {"--steps": ["4"], "--descent": ["3"], "--trials": ["2"], "--backends": ["hashgrid", "vanilla"]}
SHORTENED = {
    "steps: int = 400": "steps: int = 4",
    '"max_steps": 100': '"max_steps": 3',
    "processes=True": "processes=False",
}
"""Replacements of text that shorten an example without options."""


@pytest.mark.usefixtures("small_images")
@pytest.mark.parametrize("example", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_example_runs(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In this process: each process of its own would import PyTorch and its compiler anew."""
    text = example.read_text()
    words = [word for option, values in QUICK.items() if f'"{option}"' in text for word in (option, *values)]
    # Fields that are trained for a few steps need no more than a few images, whose rendering takes longer.
    module = sys.modules[closed_form_data.__module__]  # a function of the same name shadows it
    monkeypatch.setattr(module, "orbit", lambda radius, count, **more: orbit(radius, min(count, 8), **more))
    trials = sys.modules[open_scene.__module__]  # whose cache would keep the shortened data for other tests
    monkeypatch.setattr(trials, "_read_scene", trials._read_scene.__wrapped__)
    monkeypatch.chdir(tmp_path)
    for steps, fewer in SHORTENED.items():
        text = text.replace(steps, fewer)
    shortened = tmp_path / example.name
    shortened.write_text(text)
    monkeypatch.setattr(sys, "argv", [str(shortened), *words])
    monkeypatch.setattr(registry, "registered", dict(registry.registered))
    before = dict(DEPTH_RESIDUALS)
    try:
        runpy.run_path(str(shortened), run_name="__main__")
    finally:
        DEPTH_RESIDUALS.clear()
        DEPTH_RESIDUALS.update(before)
    printed = capsys.readouterr().out
    assert "off by" in printed or "success" in printed
    assert "success in 0" not in printed


def test_a_backend_of_ones_own_finds_the_pose() -> None:
    example = next(path for path in EXAMPLES if path.name.startswith("04"))
    done = quietly([sys.executable, str(example)])
    assert done.splitlines()[-1].startswith("success in your own field: off by 0.40 m, then 0.0")


def test_what_is_shortened_is_there() -> None:
    text = "".join(example.read_text() for example in EXAMPLES)
    assert [steps for steps in SHORTENED if steps not in text] == []


def test_examples_are_short_and_import_the_door_and_faces_alone() -> None:
    texts = {example.name: example.read_text() for example in EXAMPLES}
    assert {name: len(text.splitlines()) for name, text in texts.items() if len(text.splitlines()) > 45} == {}
    assert [name for name, text in texts.items() if "import bidnerf as bn" not in text] == []
    deep = re.compile(r"bidnerf(_core)?\.\w+\.|import bidnerf(_core)?\.")
    assert [name for name, text in texts.items() if deep.search(text)] == []
