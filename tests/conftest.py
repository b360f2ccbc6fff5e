"""What all tests share: shape checks, threads, recorded data, and reproducible property tests."""

from __future__ import annotations

import gc
import os
import shutil
import sys
from collections import Counter
from collections.abc import Generator, Iterator
from pathlib import Path

from jaxtyping import install_import_hook

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the library does, which is imported after torch here
if not os.path.exists("/dev/nvidia0"):
    os.environ.setdefault("TRITON_INTERPRET", "1")  # read when Triton is imported, which torch may do

SHAPES = "BIDNERF_SHAPES"
"""Set to 1, it turns on run-time checks of shapes and types, which take nearly half of the time of all tests."""

if os.environ.get(SHAPES) == "1":
    # Before the first import of the project: only modules that are imported afterwards are checked.
    install_import_hook(
        [
            "bidnerf",
            "bidnerf_core",
            "bidnerf_adanerf",
            "bidnerf_bid",
            "bidnerf_cells",
            "bidnerf_hashgrid",
            "bidnerf_vanilla",
        ],
        "shape_checks.checked",
    )

import pytest
import torch
from hypothesis import HealthCheck, settings

from commands import CommandResult, Run
from once import made_once

THREADS = "BIDNERF_TEST_THREADS"
DATA = "BIDNERF_DATA"

# Small tensors: a second thread costs more than it does, and results would depend on the number of cores.
torch.set_num_threads(int(os.environ.get(THREADS, "1")))

settings.register_profile(
    "bidnerf",
    derandomize=True,
    deadline=None,  # a busy machine is no fault of the code
    database=None,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("bidnerf")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Modules and tests stay until the end: searching them for garbage took a fifth of the time of their collection."""
    gc.disable()
    collected = yield
    gc.freeze()
    gc.enable()
    return collected


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the files with most slow tests first: processes that take a file at a time then end together."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recorded scenes."""
    folder = os.environ.get(DATA)
    if not folder:
        pytest.skip(f"{DATA} is not set")
    if not Path(folder).is_dir():
        pytest.fail(f"{DATA} is {folder}, which is not a folder")
    return Path(folder)


@pytest.fixture(autouse=True)
def _seeded() -> Iterator[None]:
    """Each test starts from the same global random state, alone or after others."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def three_threads() -> Iterator[None]:
    """Let torch use three threads, and restore the usual number afterwards."""
    usual = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(usual)


@pytest.fixture
def bidnerf(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs a command in this process."""
    from bidnerf.cli import main

    def run(*words: object) -> CommandResult:
        capsys.readouterr()
        status = main([str(word) for word in words])
        printed = capsys.readouterr()
        return CommandResult(status, printed.out, printed.err)

    return run


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny dataset, ``data``, and the map ``map`` that was trained of it; tests change copies of them only."""
    import tiny
    from bidnerf.cli import main

    def make(folder: Path) -> None:
        tiny.write_dataset(folder / "data")
        assert main(["train", str(folder / "data"), "--out", str(folder / "map"), *tiny.options()]) == 0

    return made_once(tmp_path_factory, "shared", make)


@pytest.fixture
def data(shared: Path, tmp_path: Path) -> Path:
    """A copy of the tiny dataset."""
    return Path(shutil.copytree(shared / "data", tmp_path / "data"))


@pytest.fixture
def map_folder(shared: Path, tmp_path: Path) -> Path:
    """A copy of the map of the tiny dataset."""
    return Path(shutil.copytree(shared / "map", tmp_path / "map"))


@pytest.fixture
def small_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """Closed-form data have images as small as those of the tiny dataset, and 64 rays judge an answer in place of 1,024."""
    import tiny
    from bidnerf.scenes import closed_form_data

    module = sys.modules[closed_form_data.__module__]  # a function of the same name shadows it
    monkeypatch.setattr(module, "DEMO_CAMERA", tiny.CAMERA)
    monkeypatch.setattr("bidnerf_bid.methods.RAYS", 64)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are files without content, since drawing them takes most of a report's time."""
    target = "bidnerf.results.plots.write_figure"
    monkeypatch.setattr(target, lambda figure, *paths, **options: [path.write_text("<svg/>") for path in paths])


@pytest.fixture
def no_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A comparison tries every map in this process: each of its own would spend seconds on importing PyTorch."""
    # Inside: what a process of a comparison does is done in this one
    from bidnerf.evaluation.run import InThisProcess

    monkeypatch.setattr("bidnerf.evaluation.comparison.local_processes", lambda count: InThisProcess())


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Switch off the tests' own check of annotations, as it is for users."""
    import jaxtyping

    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
