"""Mapping on other processes: the same landmarks as here, although a worker is lost."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any, NoReturn

import pytest
import torch

import bidnerf as bn
from bidnerf import InputError
from bidnerf.scenes import closed_form_data
from bidnerf_core.devices import map_tasks
from bidnerf_core.mapping import build_landmarks, landmark_tensors
from bidnerf_core.progress import Progress, job_context
from bidnerf_core.registry import registered
from bombs import png_of
from commands import Run, assert_refused


@pytest.mark.slow
def test_landmarks_are_those_of_this_process_though_a_worker_is_killed() -> None:
    distributed = pytest.importorskip("distributed")
    dataset = closed_form_data("demo:room")
    views = dataset.views("train", dataset.frame_names("train")[:8])
    expected, killed = build_landmarks(views), list[int]()
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as local:

        def kill_a_worker(progress: Progress) -> None:
            if progress.done == 4 and not killed:
                killed.append(local.workers[0].process.pid)
                os.kill(killed[0], signal.SIGKILL)

        with bn.cluster(local.scheduler_address), job_context(kill_a_worker):
            found = build_landmarks(views)
    assert killed
    assert len(found) > 100
    tensors = landmark_tensors(expected)
    for name, value in landmark_tensors(found).items():
        assert torch.equal(value, tensors[name]), name


def test_a_cluster_without_workers_is_refused() -> None:
    with pytest.raises(InputError, match="workers is 0, expected 1 or more"), bn.cluster(0):
        pass


def worker_address() -> str:
    """The address of the dask worker that runs this."""
    import distributed

    return str(distributed.get_worker().address)


@pytest.mark.parametrize("command", ["poses", "train"])
def test_a_command_lets_the_workers_of_a_scheduler_do_the_tasks(
    command: str, bidnerf: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed, addresses = pytest.importorskip("distributed"), set[str]()

    def find_poses(*_: Any, **__: Any) -> NoReturn:
        """Find out where tasks are done."""
        addresses.update(map_tasks(worker_address, [()] * 4))
        raise InputError("these photos show nothing")

    monkeypatch.setitem(registered, ("posers", "none"), find_poses)
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.png").write_bytes(png_of(64, 48))
    options = {"protocol": "tcp", "dashboard_address": None, "silence_logs": 50}
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, **options) as local:
        words = [command, photos, "--out", tmp_path / "x", "--poser", "none", "--dask", local.scheduler_address]
        assert_refused(bidnerf(*words), 1, "these photos show nothing", after_remarks=True)
        assert addresses == {worker.address for worker in local.workers.values()}
