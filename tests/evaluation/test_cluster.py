"""Mapping on other processes: the same landmarks as here, although a worker is lost."""

from __future__ import annotations

import os
import signal

import pytest
import torch

import bidnerf as bn
from bidnerf import InputError, View
from bidnerf.scenes import closed_form_data
from bidnerf_core.mapping import build_landmarks, landmark_tensors
from bidnerf_core.progress import Progress, job_context


def room() -> list[View]:
    dataset = closed_form_data("demo:room")
    return dataset.views("train", dataset.frame_names("train")[:8])


@pytest.mark.slow
def test_landmarks_are_those_of_this_process_though_a_worker_is_killed() -> None:
    distributed = pytest.importorskip("distributed")
    views = room()
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
