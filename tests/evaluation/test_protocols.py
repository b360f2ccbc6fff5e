"""The protocols by name: which frames, which seeds, and where each trial begins."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.stats import kstest

from bidnerf.evaluation import PROTOCOLS

# Inside: distributions of many starts, which trials draw one at a time
from bidnerf.evaluation.plan import inerf_start
from bidnerf.results import pose_error
from bidnerf_core.geometry import SE3
from refusals import refused

TRUE = SE3.exp(torch.tensor([0.3, 1.0, -2.0, 0.5, -0.2, 0.9], dtype=torch.float64))
by_name = pytest.mark.parametrize("name", PROTOCOLS)


@by_name
def test_a_protocol_follows_from_its_seed_alone(name: str) -> None:
    protocol = PROTOCOLS[name]
    cases = protocol.cases(9, protocol.trials, protocol.seed)
    np.random.seed(5)
    torch.manual_seed(5)
    assert protocol.cases(9, protocol.trials, protocol.seed) == cases
    assert protocol.cases(9, 7, protocol.seed) == cases[:7]
    once = name == "none"  # without a start, trying a frame again tells nothing new
    assert len({seed for _, seed in cases}) == (9 if once else protocol.trials)
    assert not once or len({place for place, _ in cases}) == 9
    assert all(0 <= place < 9 for place, _ in cases)
    for _, seed in cases[:3]:
        first, again = (protocol.start(TRUE, protocol.sizes[0], seed) for _ in range(2))
        assert (first is None) == (name == "none")
        if first is not None and again is not None:
            assert torch.equal(first.matrix(), again.matrix())
            assert bool(first.is_rigid(1e-9))


@by_name
def test_a_size_has_to_be_of_the_protocols_kind(name: str) -> None:
    protocol = PROTOCOLS[name]
    for size in protocol.sizes:
        protocol.check_size(size)
    for wrong in ((*protocol.sizes[0], 1.0), (math.nan,) * len(protocol.units) or (1.0,)):
        with refused(found=f"size is {':'.join(f'{x:g}' for x in wrong)}"):
            protocol.check_size(wrong)


def test_frames_take_turns() -> None:
    places = [place for place, _ in PROTOCOLS["bid"].cases(5, 12, 0)]
    assert sorted(places[:5]) == sorted(places[5:10]) == list(range(5))
    assert places != [place for place, _ in PROTOCOLS["bid"].cases(5, 12, 1)]
    places = [place for place, _ in PROTOCOLS["inerf"].cases(9, 25, 0)]
    assert len(set(places)) == 5
    assert places == sorted(places, key=places.index)


def test_inerf_fills_its_ranges_evenly() -> None:
    starts = TRUE.inverse() @ SE3.stack([inerf_start(TRUE, seed) for seed in range(600)])
    moves, angles = starts.translation, pose_error(starts, SE3.identity()).rotation_deg
    for axis in range(3):
        assert kstest(moves[:, axis].numpy(), "uniform", (-0.2, 0.4)).pvalue > 0.01
    assert kstest(angles.numpy(), "uniform", (0, 40)).pvalue > 0.01
    assert starts.log()[:, 3:].mean(0).abs().max() < 0.05  # rad
