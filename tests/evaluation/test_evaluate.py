"""Evaluation from Python: in memory, from any thread, cancelled and resumed, and the same as from the command line."""

from __future__ import annotations

import dataclasses
import json
import math
import pickle
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import bidnerf as bn
import tiny
from bidnerf.cli import main
from bidnerf.evaluation import (
    Plan,
    ResultTable,
    Trial,
    TrialResult,
    open_scene,
    peak_memory_bytes,
    read_results,
    read_runs,
    reset_peak_memory,
    run_trial,
)

# Inside: a map that stays in memory, and processes that outlive an evaluation
from bidnerf.evaluation.run import InThisProcess
from bidnerf.results import pose_error
from bidnerf.scenes import closed_form_data, closed_form_map
from bidnerf_core.datasets import DatasetOptions, open_dataset
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import find_method
from bidnerf_core.progress import Progress
from bidnerf_core.registry import registered
from optional import require
from refusals import refused
from trial_results import timeless

QUICK: dict[str, Any] = {
    "method": "bid",
    "config": {"rays": 16, "max_steps": 2},
    "protocol": "bid",
    "sizes": [0.3],
}
WORDS = ["--method", "bid", "--rays", "16", "--max-steps", "2", "--size", "0.3", "--workers", "1"]
BLOBS = "demo:blobs"

pytestmark = pytest.mark.usefixtures("small_images")


def quick(**more: Any) -> Plan:
    """A plan of few rays and steps."""
    return Plan(**QUICK | more)


def placeless(rows: Any) -> list[TrialResult]:
    """The results without the names of their map and data too."""
    return [dataclasses.replace(row, trial=dataclasses.replace(row.trial, map="", data="")) for row in timeless(rows)]


def write_masks(folder: Path, data: Path, shown: Callable[[int], Any]) -> Path:
    """Write masks of the test frames; ``shown`` gives the pixels of each by its number, 255 where they are shown."""
    folder.mkdir()
    for number, name in enumerate(open_dataset(data).frame_names("test")):
        mask = np.empty((tiny.SIZE, tiny.SIZE), np.uint8)
        mask[:] = shown(number)
        iio.imwrite(folder / f"{name}.png", mask)
    return folder


def test_a_table_has_what_the_command_writes(shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, data = shared / "map", shared / "data"
    words = ["evaluate", str(scene), str(data), "--out", str(tmp_path / "command.jsonl"), "--trials", "3"]
    assert main([*words, *WORDS, "--fault", "none", "blur:1"]) == 0
    expected = timeless(read_results([tmp_path / "command.jsonl"]))
    plan = quick(trials=3, faults=["none", "blur:1"])
    capsys.readouterr()
    table = bn.evaluate(scene, data, plan, out=tmp_path / "python.jsonl")
    assert capsys.readouterr() == ("", "")
    assert timeless(table.rows) == expected == timeless(read_results([tmp_path / "python.jsonl"]))
    loaded, dataset = bn.load_map(scene), open_dataset(data)
    in_memory = bn.evaluate(loaded, dataset, plan)
    assert placeless(in_memory.rows) == placeless(table.rows)
    assert [row.trial.map for row in in_memory.rows] == [loaded.info.backend] * 6
    assert placeless(bn.evaluate(loaded, dataset.views("test"), plan).rows) == placeless(table.rows)


@pytest.mark.usefixtures("undrawn")
def test_a_table_is_summed_up_as_its_report_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = bn.evaluate(BLOBS, BLOBS, quick(trials=4))
    (group,) = table.groups
    found = require(group.summary.success["5deg 0.05"])
    assert (group.title, group.label, found.rate.trials) == ("bid 0.3", "bid", 4)
    assert 0 <= found.rate.low <= found.rate.rate <= found.rate.high <= 1
    assert "5deg 0.05" in str(table)
    assert "bid 0.3" in str(table)
    table.save(tmp_path / "r.jsonl")
    assert main(["report", str(tmp_path / "r.jsonl"), "--out", str(tmp_path / "report")]) == 0
    assert str(table) in capsys.readouterr().out


def test_a_map_is_read_once_until_it_changes(shared: Path, tmp_path: Path) -> None:
    """Also by processes of a cluster, which outlive an evaluation; training again under the same name is noticed."""
    scene, data, found = tmp_path / "map", shared / "data", []
    for steps in (4, 8):
        words = ["train", str(data), "--out", str(scene), "--overwrite", *tiny.options(steps)]
        assert main(words) == 0
        found += [open_scene(scene, data, plan)[0] for plan in (Plan(), quick(trials=1))]
        (row,) = bn.evaluate(scene, data, quick(trials=1)).rows
        assert row.weights == found[-1].training == bn.load_map(scene).info.weights
    assert found[0] is found[1] is not found[2] is found[3]


def test_results_of_another_map_in_memory_are_not_taken_for_its_own(tmp_path: Path) -> None:
    """Maps in memory have no file of weights, so that their content tells them apart."""
    first, second = (bn.train(tiny.views(), config=tiny.config(steps), bake=False) for steps in (2, 6))
    given: dict[str, Any] = {"data": tiny.views(2), "plan": quick(trials=1), "out": tmp_path / "r.jsonl"}
    (row,) = bn.evaluate(first, **given).rows
    assert row.weights == first.training
    assert timeless(bn.evaluate(first, **given).rows) == timeless([row])
    with refused(where=tmp_path / "r.jsonl", found=f"({first.training}, expected {second.training})"):
        bn.evaluate(second, **given)


@patch.dict(registered, clear=True)
def test_what_this_process_alone_has_registered_is_not_mistaken_for_what_is_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mine = dataclasses.replace(find_method("bid"), summary="mine")
    bn.register("methods", "bid", mine, replace=True)
    bn.register("methods", "unused", mine)
    assert len(bn.evaluate(BLOBS, BLOBS, quick(trials=2)).rows) == 2

    class Elsewhere(InThisProcess):
        """What another process does: it gets copies, and nothing is registered there."""

        def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
            with patch.dict(registered, clear=True):
                return super().submit(*pickle.loads(pickle.dumps((fn, *args))), **kwargs)

    monkeypatch.setattr("bidnerf.evaluation.run.local_processes", lambda count: Elsewhere())
    monkeypatch.setattr("bidnerf.evaluation.comparison.local_processes", lambda count: Elsewhere())
    said = "method 'bid' was registered in one process but is unknown in another"
    with refused(found=said):
        bn.evaluate(BLOBS, BLOBS, quick(trials=2), workers=2)
    assert len(bn.evaluate(BLOBS, BLOBS, quick(trials=2, method="inerf"), workers=2).rows) == 2
    with refused(found=said):
        bn.compare([BLOBS], BLOBS, quick(trials=1))


def test_results_say_where_a_map_in_memory_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the plan's device says, which is for maps in folders. No trial is run: a meta device computes nothing."""
    scene = bn.train(tiny.views(2), config=tiny.config(1), bake=False)
    assert isinstance(scene.field, torch.nn.Module)
    elsewhere = dataclasses.replace(scene, field=scene.field.to("meta"))
    seen: list[Any] = []

    def stop(trial: Any, *_: Any) -> None:
        seen.append(trial.device)
        raise LookupError("no trial is run")

    for module, name in (("run", "run_trial"), ("comparison", "run_trial")):
        monkeypatch.setattr(import_module(f"bidnerf.evaluation.{module}"), name, stop)
    for begin in (
        lambda: bn.evaluate(elsewhere, tiny.views(2), quick(trials=1)),
        lambda: bn.compare([elsewhere], tiny.views(2), quick(trials=1)),
        lambda: bn.compare([BLOBS], tiny.views(2), quick(trials=1)),
    ):
        with pytest.raises(LookupError):
            begin()
    assert seen == ["meta", "meta", "cpu"]


def test_masks_hide_parts_of_the_images_in_every_trial(shared: Path, tmp_path: Path) -> None:
    scene, data = shared / "map", shared / "data"
    half = np.where(np.arange(tiny.SIZE) < tiny.SIZE // 2, 0, 255)
    hiding = ["--masks", str(write_masks(tmp_path / "masks", data, lambda _: half))]
    words = [str(scene), str(data), *WORDS, "--trials", "2", "--seed", "5"]
    for number, more in enumerate(([], hiding, [*hiding, "--mask-hides", "white"])):
        assert main(["evaluate", *words, *more, "--out", str(tmp_path / f"{number}.jsonl")]) == 0
    whole, black, white = (read_results([tmp_path / f"{number}.jsonl"]) for number in range(3))
    assert len({result[0].loss for result in (whole, black, white)}) == 3
    given, hidden = (
        (bn.load_map(scene), open_dataset(data, masks=hiding[1])),
        DatasetOptions(split="test", masks=hiding[1]),
    )
    in_memory = bn.evaluate(*given, quick(trials=2, seed=5))
    again = bn.evaluate(scene, data, quick(trials=2, seed=5, images=hidden))
    assert [r.T_world_camera for r in in_memory.rows] == [r.T_world_camera for r in black]
    assert timeless(again.rows) == timeless(black)
    assert black[0].trial.images.masks == "masks"
    labels = {group.label for group in ResultTable((*whole, *black, *white)).groups}
    assert labels == {"bid, nothing hidden", "bid, black of masks hidden", "bid, white of masks hidden"}
    compared = bn.compare([bn.load_map(scene)], data, quick(trials=2, seed=5, images=hidden))
    assert placeless(compared.results[0]) == placeless(black)


def test_frames_that_masks_hide_wholly_are_named_and_left_out(
    shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, data = shared / "map", shared / "data"
    names = open_dataset(data).frame_names("test")
    place = write_masks(tmp_path / "masks", data, lambda number: 255 if number else 0)
    words = [str(scene), str(data), *WORDS, "--masks", str(place)]
    assert main(["evaluate", *words, "--trials", "6", "--out", str(tmp_path / "r.jsonl")]) == 0
    told = f"masks hide 1 whole frame of {len(names)}, not tried: {names[0]}\n"
    assert capsys.readouterr().err.count(told) == 1
    assert {row.frame for row in read_results([tmp_path / "r.jsonl"])} == set(names[1:])
    images = DatasetOptions(split="test", masks=place)
    with pytest.warns(bn.InputWarning, match="1 whole frame"):
        found = bn.compare([bn.load_map(scene)], data, quick(trials=6, images=images))
    assert {row.frame for row in found.results[0]} == set(names[1:])
    with refused(where=place, found=f"1 whole frame of 1, not tried: {names[0]};") as caught:
        bn.evaluate(scene, data, quick(frames=names[:1], images=images))
    assert "`mask_hides`" in caught.error.found


def test_a_file_of_results_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "r.jsonl"
    with refused(where=out, found="cannot be written", expected="a file"):
        bn.evaluate(BLOBS, BLOBS, quick(trials=1), out=out)


def test_any_thread_evaluates_and_leaves_no_trace() -> None:
    expected = timeless(bn.evaluate(BLOBS, BLOBS, quick(trials=2)).rows)
    handler, threads = signal.getsignal(signal.SIGINT), torch.get_num_threads()
    found: dict[int, Any] = {}

    def work(number: int) -> None:
        scene, data = closed_form_map(BLOBS), closed_form_data(BLOBS)
        found[number] = placeless(bn.evaluate(scene, data, quick(trials=2)).rows)

    others = [threading.Thread(target=work, args=(number,)) for number in range(2)]
    for other in others:
        other.start()
    for other in others:
        other.join()
    assert found[0] == found[1] == placeless(expected)
    assert (signal.getsignal(signal.SIGINT), torch.get_num_threads()) == (handler, threads)


@pytest.mark.slow
def test_a_cancelled_evaluation_goes_on(tmp_path: Path) -> None:
    out, stop = tmp_path / "r.jsonl", threading.Event()
    seen: list[Progress] = []

    def stop_at_two(progress: Progress) -> None:
        seen.append(progress)
        if progress.done == 2:
            stop.set()

    with pytest.raises(bn.Cancelled, match=r"3 trials are left in .*, the same command resumes"):
        bn.evaluate(BLOBS, BLOBS, quick(trials=5), out=out, progress=stop_at_two, cancel=stop.is_set)
    assert [(p.stage, p.done, p.total, p.unit) for p in seen] == [("trials", n, 5, "trials") for n in (1, 2)]
    before = out.read_bytes()
    assert len(read_results([out])) == 2
    table = bn.evaluate(BLOBS, BLOBS, quick(trials=5), out=out)
    assert out.read_bytes().startswith(before)
    assert timeless(table.rows) == timeless(bn.evaluate(BLOBS, BLOBS, quick(trials=5)).rows)
    with pytest.raises(bn.Cancelled, match="nothing is stored"):
        bn.evaluate(BLOBS, BLOBS, quick(trials=1), cancel=lambda: True)


def test_an_error_of_the_callback_is_the_callers_and_its_trial_is_kept(tmp_path: Path) -> None:
    def fail(progress: Progress) -> None:
        raise LookupError(str(progress))

    with pytest.raises(LookupError, match=r"trials: 1/3 trials, \d within"):
        bn.evaluate(BLOBS, BLOBS, quick(trials=3), out=tmp_path / "r.jsonl", progress=fail)
    assert len(read_results([tmp_path / "r.jsonl"])) == 1


@pytest.mark.usefixtures("unchecked")
def test_what_cannot_be_evaluated_is_refused() -> None:
    for one, named in ((BLOBS, BLOBS), (Path("map"), "map"), (closed_form_map(BLOBS), "closed-form")):
        with refused(found=f"scenes is the one map {named}", expected="a list of maps"):
            bn.compare(one, BLOBS)  # type: ignore[arg-type]
    scene, view = closed_form_map(BLOBS), tiny.views(1)[0]
    wrong: list[tuple[dict[str, Any], str, str | None]] = [
        ({"workers": 2}, "workers is 2", "1: other processes read the map"),
        ({"trials": 0}, "trials is 0", "a whole number, 1 to 100,000"),
        ({"trials": 2.5}, "trials is 2.5", "a whole number, 1 to 100,000"),
        ({"trials": 2.0}, "trials is 2.0", "a whole number"),
        (
            {"images": DatasetOptions(camera=tiny.CAMERA)},
            "camera is a Intrinsics",
            "text, a number or the path of a file",
        ),
        ({"images": DatasetOptions("cam.json", split="test")}, "leave out `camera`", None),
        ({"scene": BLOBS, "workers": 0}, "workers is 0", "1 or more"),
        ({"scene": BLOBS, "workers": -1}, "workers is -1", "1 or more"),
        ({"seed": -1}, "seed is -1", "a whole number, 0 to 2,147,483,647"),
        ({"sizes": [(0.3, 1.0)]}, "size is 0.3:1", "LENGTH from 0 to 1e+06"),
        ({"config": {"ray": 3}}, "'ray', did you mean 'rays'?", None),
        ({"faults": ["blurr:1"]}, "no fault 'blurr'", None),
        ({"faults": "blur:1"}, "faults is 'blur:1'", "a list, such as ['blur:1']"),
        ({"frames": "0001"}, "frames is '0001'", "a list, such as ['0001']"),
        ({"sizes": ["far"]}, "sizes is ['far']", "float or a list"),
        ({"data": 3}, "data is a int", "a folder, a dataset or a list of views"),
        ({"data": [1]}, "data is a list", "a folder, a dataset or a list of views"),
        ({"data": [view, view]}, "data holds 2 frames named '0000'", "different names"),
    ]
    for change, found, expected in wrong:
        given = {"scene": scene, "data": BLOBS, "workers": 1} | change
        first, data, workers = (given.pop(name) for name in ("scene", "data", "workers"))
        with refused(found=found, expected=expected):
            bn.evaluate(first, data, quick(**{"trials": 1} | given), workers=workers)
    with refused(expected="one size and one fault"):
        bn.compare([scene], BLOBS, quick(sizes=[0.3, 0.5]))


@pytest.mark.usefixtures("no_processes")
def test_maps_in_memory_and_in_folders_are_compared(shared: Path) -> None:
    plan = quick(trials=2)
    scene, data = bn.load_map(shared / "map"), shared / "data"
    seen: list[str] = []
    maps = {"one": scene, "folder": shared / "map", "same": scene}
    found = bn.compare(maps, data, plan, progress=lambda p: seen.append(str(p)))
    assert [row.map for row in found.rows] == list(maps)
    assert len(seen) == 6
    first, other, third = map(placeless, found.results)
    assert first == other == third
    assert found.rows[0].map_bytes > 0
    named = bn.compare({"mine": scene}, open_dataset(data), plan)
    assert [row.map for row in named.rows] == ["mine"]
    assert "mine" in str(named)
    with pytest.raises(bn.Cancelled):
        bn.compare([scene], data, plan, cancel=lambda: True)


# Single trials, and trials on a cluster.


@pytest.fixture
def trial(shared: Path) -> Trial:
    folders = str(shared / "map"), str(shared / "data")
    return Trial(*folders, ("t_0001",), (0.5,), 3, protocol="bid", method="bid", config='{"max_steps": 4, "rays": 64}')


def test_a_line_has_what_localize_prints_and_more(
    trial: Trial, shared: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = run_trial(trial)
    line, portable = result.plain(), result.trial
    assert portable == trial.portable == trial.portable.portable
    assert hash(portable) == hash(trial.portable)
    error = pose_error(
        SE3.from_matrix(torch.tensor(line["T_world_camera"]).double()), tiny.views(3, seed=1)[1].T_ref_camera
    )
    assert line["error"]["translation"] == pytest.approx(float(error.translation), abs=1e-6)
    capsys.readouterr()
    words = [
        "localize",
        str(shared / "map"),
        str(shared / "data"),
        "--frame",
        "t_0001",
        "--json",
        "--perturb",
        "0.1",
        "5",
    ]
    assert main([*words, "--method", "bid", "--max-steps", "2", "--rays", "32"]) == 0
    assert json.loads(capsys.readouterr().out).keys() <= line.keys()
    assert json.loads(json.dumps(line, allow_nan=False)) == line
    assert (line["frame"], line["seed"], line["steps"]) == ("t_0001", 3, 4)
    assert line["start_error"]["translation"] == pytest.approx(0.5, rel=0.01)  # exp bends it a little
    assert line["start_error"]["rotation_deg"] == pytest.approx(math.degrees(0.2))
    for kind in ("translation", "rotation_deg"):
        assert len(line["errors"][kind]) == 5
        assert line["errors"][kind][0] == pytest.approx(line["start_error"][kind])
        assert line["errors"][kind][-1] == pytest.approx(line["error"][kind])
    assert (line["settings"]["rays"], line["settings"]["depth_weight"]) == (64, 1.0)
    assert line["weights"].startswith("weights-")
    assert line["peak_memory_bytes"] > 10**7


def test_the_same_trial_gives_the_same_line(trial: Trial) -> None:
    (first,) = timeless([run_trial(trial)])
    torch.manual_seed(17)
    assert timeless([run_trial(trial)]) == [first]
    other = run_trial(dataclasses.replace(trial, seed=4))
    assert other.start_error is not None
    assert other.T_world_camera != first.T_world_camera


def test_a_trial_without_depth_is_given_none(trial: Trial, tmp_path: Path) -> None:
    """Whatever the weight of depth: as if the data had none."""
    tiny.write_dataset(tmp_path / "data", depth=False)
    blind = run_trial(dataclasses.replace(trial, depth=False))
    bare = run_trial(dataclasses.replace(trial, data=str(tmp_path / "data")))
    assert blind.T_world_camera == bare.T_world_camera
    assert blind.T_world_camera != run_trial(trial).T_world_camera


def test_a_trial_that_cannot_be_is_refused(trial: Trial) -> None:
    """Plans refuse most of it before; a trial may come from elsewhere."""
    without: dict[str, Any] = {"protocol": "none", "size": ()}
    wrong: list[tuple[dict[str, Any], str | None, str, str | None]] = [
        ({"protocol": "bit"}, None, "no protocol 'bit', did you mean 'bid'?", None),
        ({"size": ()}, None, "size is missing", "LENGTH from 0 to 1e+06"),
        ({"config": '{"ray": 1}'}, "config", "'ray', did you mean 'rays'?", None),
        ({"config": "{"}, "config", "not JSON", "settings of bid"),
        (without, None, "method 'bid' needs a start", None),
        (without | {"method": "auto", "config": "{}"}, "the map has no surface", "method 'auto'", None),
        ({"method": "magic"}, None, "no method 'magic'", None),
        ({"frames": ("nope",)}, "split 'test'", "no frame 'nope'", "'t_0000'"),
    ]
    for change, where, found, expected in wrong:
        with refused(where=where, found=found, expected=expected):
            run_trial(dataclasses.replace(trial, **change))


def test_peak_memory_is_of_what_went_on_since() -> None:
    reset_peak_memory()
    before = peak_memory_bytes()
    block = torch.ones(40_000_000)
    assert peak_memory_bytes() >= before + 100_000_000
    del block
    reset_peak_memory()
    assert peak_memory_bytes() < before + 100_000_000


def test_two_dask_workers_give_the_results_of_one_process(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    six = ("--trials", "6")
    alone, together = tmp_path / "alone.jsonl", tmp_path / "together.jsonl"
    assert main(["evaluate", "demo:blobs", "--out", str(alone), *WORDS, *six]) == 0
    # Workers that are threads of this process: what they get and send goes through sockets all the same, and nothing is imported anew.
    options = {"protocol": "tcp", "dashboard_address": None, "silence_logs": 50}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False, **options) as cluster:
        words = ["evaluate", "demo:blobs", "--out", str(together), "--dask", cluster.scheduler_address]
        assert main([*words, *six, *WORDS[:-2]]) == 0
    assert timeless(read_results([alone])) == timeless(read_results([together]))
    (run,) = read_runs(together)
    assert run.workers == "dask, 2 threads"


def test_a_scheduler_that_is_not_there_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("bidnerf.evaluation.run.PATIENCE", "1s")
    out = tmp_path / "r.jsonl"
    assert main(["evaluate", "demo:blobs", "--out", str(out), "--dask", "tcp://127.0.0.1:9", *WORDS[:-2]]) == 1
    said = capsys.readouterr().err.splitlines()
    assert "no dask scheduler at tcp://127.0.0.1:9" in said[-1]
