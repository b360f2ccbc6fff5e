"""How quick the live viewer is in headless Chromium (software WebGL): first picture, answers while it localizes, frames a second.

The cameras of the map are repeated up to ``--cameras``, so that a small map stands for one of many images. Needs Playwright and
Chromium::

    python benchmarks/viewer.py MAP:DATA
"""

from __future__ import annotations

import os
import shutil
import statistics
import tempfile
import threading
import time
import urllib.request
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import imageio.v3 as iio
from _lab import Row, Scene, one_thread, parser, record
from playwright.sync_api import sync_playwright

from bidnerf import Localizer
from bidnerf.viewer import LiveView, serve_view

ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
SIZE = {"width": 1280, "height": 800}
TURNING = 3.0  # seconds for which the map is turned
TURN = """async (seconds) => {
  const { space } = window.page, began = performance.now(), first = space.drawn, from = space.camera.position.clone();
  while (performance.now() - began < 1000 * seconds) {
    const t = (performance.now() - began) / 1000, target = space.controls.target;
    const off = from.clone().sub(target).applyAxisAngle(space.camera.up, 0.7 * t);
    space.camera.position.copy(target).add(off);
    space.controls.update();
    space.changed();
    await new Promise(requestAnimationFrame);
  }
  return (space.drawn - first) / seconds;
}"""


def resident() -> float:
    """Return the memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def opened(browser: Any, address: str) -> tuple[Any, float]:
    """Return a page of the viewer and the seconds until the map was drawn."""
    page = browser.new_page(viewport=SIZE)
    began = time.perf_counter()
    page.goto(address)
    while not page.evaluate("(window.page?.space?.drawn ?? 0) > 0"):
        page.wait_for_timeout(5)
    return page, time.perf_counter() - began


def answers_while_localizing(page: Any, address: str, photo: Path) -> Row:
    """Return how long the server takes to answer while a photo is localized, and how long that takes."""
    page.set_input_files("#photo", photo)
    began, taken = time.perf_counter(), list[float]()
    while not page.evaluate("page.answers.length > 0 && document.getElementById('note').textContent === ''"):
        asked = time.perf_counter()
        urllib.request.urlopen(f"{address}/health").read()
        taken.append(1000 * (time.perf_counter() - asked))
    return {
        "seconds_to_answer_with_pictures": time.perf_counter() - began,
        "answers": len(taken),
        "median_ms": statistics.median(taken),
        "largest_ms": max(taken),
    }


def main() -> None:
    options = parser(__doc__, "viewer")
    options.add_argument("scene", metavar="MAP:DATA", help="folder of a map, folder of its dataset")
    options.add_argument("--cameras", type=int, default=200)
    options.add_argument("--rounds", type=int, default=5)
    given = options.parse_args()
    one_thread()
    scene = Scene.open(given.scene)
    cameras = scene.map.info.cameras
    many = tuple(cameras[place % len(cameras)] for place in range(given.cameras))
    shown = replace(scene.map, info=replace(scene.map.info, cameras=many))
    before, began = resident(), time.perf_counter()
    ready, stop = SimpleQueue[str](), threading.Event()
    work = {"port": 0, "ready": ready.put, "stop": stop}
    server = threading.Thread(target=serve_view, args=(LiveView(Localizer(shown)),), kwargs=work)
    server.start()
    address = ready.get()
    started = time.perf_counter() - began
    with urllib.request.urlopen(address) as reply:
        page_bytes = len(reply.read())
    rounds = list[Row]()
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        for view in scene.views(count=given.rounds):
            photo = Path(folder) / f"{view.frame.name}.png"
            iio.imwrite(photo, (view.frame.rgb * 255).round().byte().numpy())
            page, first = opened(browser, address)
            row = {"first_picture_seconds": first, "frames_a_second": page.evaluate(TURN, TURNING)}
            row |= answers_while_localizing(page, address, photo)
            row["page_mebibytes"] = page.evaluate("performance.memory.usedJSHeapSize") / 2**20
            rounds.append(row)
            print(row, flush=True)
            page.close()
        version = browser.version
        browser.close()
    stop.set()
    server.join()
    record(
        given.name,
        {
            "scene": scene.name,
            "cameras": given.cameras,
            "surfels": len(shown.surface.surfels) if shown.surface else 0,
            "chromium": version,
            "window": SIZE,
            "start_seconds": started,
            "page_megabytes": page_bytes / 1e6,
            "server_mebibytes_added": resident() - before,
            "median": {k: statistics.median(r[k] for r in rounds) for k in rounds[0]},
            "rounds": rounds,
        },
    )


if __name__ == "__main__":
    main()
