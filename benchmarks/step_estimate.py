"""An estimate of a step's time on a GPU, without one, from the number of operations and bytes of a step of ``bid``.

    python benchmarks/step_estimate.py DATA --map MAP [MAP ...] --name step_estimate_lego

The step runs on the simulated device of ``bidnerf_core.testing.simulated_device``, with the shapes that it would have on a GPU. Each
operation that is not a mere view counts as one kernel, which reads its arguments and writes its results once; matrix products
count 2 m n k operations. From these follow three lower bounds, of which the largest is the estimate: traffic at ``BANDWIDTH``,
arithmetic at ``ARITHMETIC``, and launches at ``LAUNCH`` each. It is an estimate and not a measurement: caches make traffic
cheaper, and scattered reads make it more expensive. With a CUDA graph, launches cost next to nothing; the step has no waits and
no shapes that depend on values, as a graph requires.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch
from gpu import TIMED_RAYS, made_steps
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from bidnerf_core.devices import without_waiting
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.evaluation.trials import opened
from bidnerf_core.fields.contract import levels
from bidnerf_core.testing.simulated_device import DEVICE, Elsewhere

RESULTS = Path(__file__).parent / "results"
BANDWIDTH = 0.6 * 3.35e12
"""Bytes per second: 60 % of what the memory of an H100 SXM can do."""
ARITHMETIC = 0.5 * 67e12
"""Operations per second: half of an H100's single precision."""
LAUNCH = 5e-6
"""Seconds that PyTorch takes to launch an operation from Python."""


class Counter(TorchDispatchMode):
    """Counts kernels, bytes and operations of matrix products."""

    def __init__(self) -> None:
        super().__init__()
        self.kernels, self.bytes, self.operations = 0, 0, 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        schema = func._schema
        is_view = any(r.alias_info is not None and not r.alias_info.is_write for r in schema.returns)
        if not is_view and schema.name not in ("aten::detach", "aten::_unsafe_view"):
            tensors = [t for t in tree_leaves((args, kwargs, found)) if isinstance(t, Tensor)]
            self.kernels += 1
            self.bytes += sum(t.numel() * t.element_size() for t in tensors)
            if schema.name in ("aten::mm", "aten::addmm", "aten::bmm"):
                self.operations += 2 * found.numel() * args[-2].shape[-1]
        return found


def counted(folder: str, data: str, level: int, rays: int = TIMED_RAYS) -> dict[str, Any]:
    """Return the counts of a step, and the estimate in milliseconds, with launches and without."""
    with Elsewhere():
        steps = made_steps(folder, data, level, DEVICE, rays)
        with without_waiting():
            steps(0)
            with Counter() as count:
                steps(1)
    device = max(count.bytes / BANDWIDTH, count.operations / ARITHMETIC)
    return {
        "kernels": count.kernels,
        "bytes": count.bytes,
        "operations": count.operations,
        "estimated_ms": 1000 * max(device, count.kernels * LAUNCH),
        "estimated_ms_as_graph": 1000 * device,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data")
    parser.add_argument("--map", nargs="+", required=True)
    parser.add_argument("--level", type=int, nargs="+", help="default: all")
    parser.add_argument("--rays", type=int, default=TIMED_RAYS)
    parser.add_argument("--name", required=True, help="of the record")
    parser.add_argument("--out", type=Path, default=RESULTS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows = {
        f"{Path(folder).name}, level {level}": counted(folder, given.data, level, given.rays)
        for folder in given.map
        for level in given.level or range(len(levels(opened(folder, given.data)[0].field)))
    }
    results = {
        "rays": given.rays, "is_an_estimate": True, "bandwidth": BANDWIDTH, "arithmetic": ARITHMETIC,
        "seconds_per_launch": LAUNCH, "steps": rows,
    }  # fmt: skip
    print(write_record(given.out / f"{given.name}.json", results, seed=0))
    print(rows)


if __name__ == "__main__":
    main()
