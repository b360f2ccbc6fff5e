"""The viewer's page in a browser: live, from disk without a network, and on a phone."""

from __future__ import annotations

import base64
import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
import torch

pytest.importorskip("starlette", reason="the extra 'viewer' is not installed")
pytest.importorskip("playwright", reason="Playwright is not installed")

from playwright.sync_api import sync_playwright

import viewed
from bidnerf import SE3, Localizer, Map
from bidnerf.viewer import MapView, map_json, trajectory_json

# Inside: an answer whose descent is given, and the page as a saved file
from bidnerf.viewer.answer import answer_json
from bidnerf.viewer.pages import answer_query
from bidnerf_core.camera import CameraSource
from viewer_client import serving

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
ARGUMENTS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
DROP = """([content, name]) => {
  const bytes = Uint8Array.from(atob(content), (letter) => letter.charCodeAt(0)), dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([bytes], name, { type: "image/png" }));
  for (const kind of ["dragenter", "dragover", "drop"]) document.dispatchEvent(new DragEvent(kind, { dataTransfer, bubbles: true }));
}"""
VISIBLE = """(side) => {
  const tag = document.querySelector(`.pictures .tag.${side}`), [top, right, bottom, left] = tag.parentElement.style.clipPath.match(/\\d+/g).map(Number);
  return left + right < 100;
}"""
FARTHEST = """() => {
  const { space, map, answer } = page, off = (m) => {
    const v = new THREE.Vector3(m[3], m[7], m[11]).project(space.camera);
    return Math.max(Math.abs(v.x), Math.abs(v.y));
  };
  return { cameras: map.cameras.map(({ pose }) => off(pose)), poses: [answer.pose, answer.runner_up.pose].map(off) };
}"""
"""Where the cameras and the poses are in the window, whose edge is at 1."""
LAPTOP, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
LOOKED_AT = (
    """() => page.space.controls.target.distanceTo(new THREE.Vector3(page.pose[3], page.pose[7], page.pose[11]))"""
)
"""How far the middle of the view is from the pose that the page tells of."""
IDLE = "document.getElementById('progress').hidden"
WAIT = 120_000  # ms


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_playwright() as found:
        browser = found.chromium.launch(executable_path=CHROMIUM, headless=True, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def saved(room: Map, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with an accepted photo, a refused one with a hostile name, results and a trajectory."""
    folder = tmp_path_factory.mktemp("page")
    localizer = Localizer(room)
    answers = [
        answer_query(localizer, viewed.query()),
        answer_query(localizer, viewed.query(viewed.HOSTILE, seed=5)),
    ]
    entries = [
        {
            "frame": f"t{i}",
            "time": i / 10,
            "T_world_camera": T.matrix().tolist(),
            "outcome": "converged" if i % 3 else "ambiguous",
            "covariance": [[(1 + i) * 1e-4 * (a == b) for b in range(6)] for a in range(6)],
        }
        for i, T in enumerate(viewed.walk(12))
    ]
    (folder / "track.json").write_text(json.dumps(entries))
    pose = tuple(viewed.walk(12)[4].matrix().flatten().tolist())
    rows = [
        {
            "frame": name,
            "method": "auto",
            "outcome": outcome,
            "accepted": outcome == "converged",
            "reason": "why",
            "confidence": 0.9,
            "error": (0.01, 0.2),
            "sigma": None,
            "pose": pose,
        }
        for name, outcome in (
            ("unseen", "converged"),
            (viewed.HOSTILE, "ambiguous"),
            ("elsewhere", "imprecise"),
        )
    ]
    page = MapView(
        map_json(room), tuple(answers), trajectory=trajectory_json(folder / "track.json"), results=tuple(rows)
    )
    (folder / "notebook.html").write_text(f"<!doctype html><title>notebook</title>{page._repr_html_()}")
    return page.save(folder / "page.html")


@contextmanager
def opened(
    browser: Any,
    address: str,
    viewport: dict[str, int],
    ready: str = "(window.page?.space?.drawn ?? 0) > 0",
    **more: Any,
) -> Iterator[Any]:
    """Open a page, and fail on any message of an error, and on requests for anything but what it came from."""
    context = browser.new_context(viewport=viewport, reduced_motion="reduce", **more)
    page, faults, asked = context.new_page(), list[str](), list[str]()
    page.set_default_timeout(WAIT)
    page.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    try:
        page.goto(address)
        until(page, ready)
        yield page
        origin = "file://" if address.startswith("file:") else address.rstrip("/")
        assert not [url for url in asked if not url.startswith((origin, "data:", "blob:"))]
        assert not faults
    finally:
        context.close()


def until(page: Any, expression: str) -> None:
    """Wait until an expression is true; the page's policy forbids it to evaluate one by itself."""
    end = time.monotonic() + WAIT / 1000
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"not within {WAIT / 1000:g} s: {expression}"
        page.wait_for_timeout(20)


def value(page: Any, field: str) -> str:
    return str(page.input_value(field))


def test_a_photo_is_chosen_and_localized_live(browser: Any, room: Map, tmp_path: Path) -> None:
    photo = viewed.photo_file(tmp_path, "a <b>photo.png")
    with (
        serving(room, camera=CameraSource(hfov=61.5)) as client,
        opened(browser, f"http://127.0.0.1:{client.port}/", LAPTOP) as page,
    ):
        assert page.title().startswith("map")
        assert value(page, "#hfov") == "61.5"
        page.fill("#hfov", "")
        page.evaluate("document.activeElement.blur()")
        assert page.locator("#query option").count() == 2  # one asks to choose
        assert page.is_visible("#answer .lead")  # the panel says what to do, and shows the map's images
        page.click("#gallery button >> nth=2")
        where = "page.space.camera.position.distanceTo(new THREE.Vector3(...[3, 7, 11].map((i) => page.map.cameras[2].pose[i])))"
        assert page.evaluate(where) < 1e-6
        page.set_input_files("#photo", photo)
        page.wait_for_selector(".outcome.good")
        until(page, IDLE)
        assert page.text_content("#verdict .name") == "a <b>photo.png"
        assert page.evaluate("page.space.layers.answer.getObjectByName('ellipsoid') !== undefined")
        page.keyboard.press("v")
        until(page, "(page.live.shown ?? 0) > 1")
        assert page.evaluate("document.getElementById('field').naturalWidth") > 0
        page.keyboard.press("v")
        page.keyboard.press("p")  # the image that the viewer was started with
        until(page, "page.answers.length === 2 && " + IDLE)
        assert page.text_content("#verdict .name") == "photo"
        page.evaluate(DROP, [base64.b64encode(photo.read_bytes()).decode(), "dropped.png"])
        until(page, "page.answers.length === 3 && " + IDLE)
        assert page.text_content("#verdict .name") == "dropped.png"
        page.fill("#hfov", "58.19")
        page.evaluate(DROP, [base64.b64encode(photo.read_bytes()).decode(), "with field of view.png"])
        until(page, "page.answers.length === 4 && " + IDLE)
        assert "horizontal field of view 58.19 deg" in page.evaluate("page.answer.camera")
        page.fill("#hfov", "200")
        page.evaluate(DROP, [base64.b64encode(photo.read_bytes()).decode(), "no camera.png"])
        until(page, "document.getElementById('note').textContent.includes('from 1 to 170')")


def test_a_saved_page_works_from_disk_without_a_network(browser: Any, saved: Path) -> None:
    with opened(browser, saved.as_uri(), LAPTOP, offline=True) as page:
        assert page.text_content("#verdict .name") == "unseen"
        assert "Accepted" in page.text_content(".outcome")
        for share, seen in (("0", "only rendered"), ("100", "only photo")):
            page.locator("#wipe").fill(share)
            shown = [page.evaluate(VISIBLE, side) for side in ("left", "right")]
            assert shown == [seen == "only photo", seen == "only rendered"]
        ends = page.evaluate("[...document.querySelector('.under').childNodes].map((node) => node.textContent)")
        assert ends == ["only rendered", "", "only photo"]  # from the least to the largest share of the photo
        for number, mode in enumerate(("Wipe", "Blink", "Difference", "Edges", "Depth", "Matches"), start=1):
            page.keyboard.press("Escape")
            page.evaluate("document.activeElement.blur()")
            page.keyboard.press(str(number))
            assert page.text_content(".modes [aria-pressed=true]") == mode
        assert page.locator(".pictures svg circle").count() >= 15
        ellipsoid = "page.space.layers.answer.getObjectByName('ellipsoid') !== undefined"
        assert page.evaluate(ellipsoid)
        page.keyboard.press("e")
        assert not page.evaluate(ellipsoid)


def test_a_refused_photo_tells_why_and_names_stay_text(browser: Any, saved: Path) -> None:
    with opened(browser, f"{saved.as_uri()}#frame={quote(viewed.HOSTILE)}", LAPTOP, offline=True) as page:
        assert_first_view_holds_everything(page)
        assert page.title().startswith("map")  # no script of a name has run
        assert page.text_content("#verdict .name") == viewed.HOSTILE
        assert page.text_content(".outcome b").startswith("Refused")
        assert page.locator("#figures tr.failed").count() > 0
        assert page.text_content(".advice").count("What to try: ") == 1
        assert page.is_hidden("#show-ellipsoid") is (page.evaluate("page.answer.ellipsoid") is None)
        labels = page.locator("#labels span").all_text_contents()
        assert {"pose found, refused", "runner-up"} <= {*labels}
        steps = int(page.get_attribute("#step", "max"))
        page.locator("#step").fill("0")
        assert page.text_content("#caption").startswith(f"1 of {steps + 1}")
        assert page.evaluate("page.space.layers.search.children.length") > 0
        page.evaluate("document.activeElement.blur()")
        page.keyboard.press("ArrowRight")
        assert value(page, "#step") == "1"
        assert any("this step" in label for label in page.locator("#labels span").all_text_contents())
        page.click("#runner")
        assert page.get_attribute("#runner", "aria-pressed") == "true"
        for other in (True, False):  # the view goes to the pose that is told of
            assert page.evaluate(LOOKED_AT) < 1e-6
            figures = page.locator("#figures").count()
            assert figures == (0 if other else 1)  # only those of the pose found are known
            assert page.evaluate("page.pose === page.answer.runner_up.pose") is other
            page.click("#runner")
        assert "runner-up" in page.text_content(".pictures .tag.right")
        assert "You are looking at the runner-up" in page.text_content(".banner")
        assert page.is_visible("#facts dt")
        page.keyboard.press("?")
        page.wait_for_selector("#words dt")
        keys = page.locator("#keys kbd").all_text_contents()
        assert "r" in keys
        assert "v" not in keys  # of the live viewer
        modes = page.locator(".modes button").count()
        assert f"1 … {modes}" in keys
        page.click("#space", position={"x": 200, "y": 500})
        assert not page.is_visible("#words")


def test_a_descent_can_be_replayed(browser: Any, room: Map, tmp_path: Path) -> None:
    found = Localizer(room)(viewed.query().views)
    poses, losses = SE3.stack([*viewed.walk(30), found.T_world_camera]), torch.linspace(0.5, 0.1, 30)
    answer = answer_json(room, "descent", replace(found, poses=poses, losses=losses))
    file = MapView(map_json(room), (answer,)).save(tmp_path / "page.html")
    with opened(browser, file.as_uri(), LAPTOP, offline=True) as page:
        page.locator("#step").fill("10")
        assert page.text_content("#caption") == "step 10 of 30: loss 0.362"
        assert "this step" in page.locator("#labels span").all_text_contents()
        assert page.is_visible("#losses")
        heights = [float(point.split(",")[1]) for point in page.get_attribute("#losses polyline", "points").split()]
        assert heights == sorted(heights)  # the loss falls
        page.locator("#step").fill("30")
        assert page.text_content("#caption") == "the pose found"


def test_two_points_measure_the_scale_and_rows_lead_to_their_frames(browser: Any, saved: Path) -> None:
    with opened(browser, saved.as_uri(), LAPTOP, offline=True) as page:
        page.click("#measure")
        for x in (300, 420):
            page.mouse.click(x, 420)
        ends = page.evaluate("page.measured")
        assert len(ends) == 2
        seen = page.evaluate(
            "page.measured.map((place) => { const v = new THREE.Vector3(...place).project(page.space.camera);"
            " return [(v.x + 1) / 2 * page.space.canvas.clientWidth, (1 - v.y) / 2 * page.space.canvas.clientHeight + 44]; })"
        )
        assert all(abs(x - at) < 7 and abs(y - 420) < 8 for (x, y), at in zip(seen, (300, 420), strict=True))
        length = sum((a - b) ** 2 for a, b in zip(*ends, strict=True)) ** 0.5
        page.fill("#note input", f"{2.5 * length}")
        assert page.text_content("#note code") == "bidnerf scale MAP --factor 2.5"
        page.keyboard.press("Escape")  # from the input
        assert page.evaluate("page.measured") is None
        assert page.locator("#rows tbody tr").count() == 3
        page.fill("#filter", "elsewhere")
        assert page.locator("#rows tbody tr").count() == 1
        page.click("#rows tbody tr")
        assert page.text_content("#verdict .name") == "elsewhere"
        page.fill("#filter", "")
        page.select_option("#kind", "accepted")
        page.click("#rows tbody tr")
        assert page.text_content("#verdict .name") == "unseen"
        page.locator("#time").fill("7")
        assert page.text_content("#place").startswith("8 of 12 · 0.70 s · t7 · converged")


def assert_first_view_holds_everything(page: Any) -> None:
    seen = page.evaluate(FARTHEST)
    assert 0.4 < max(seen["cameras"]) < 1.1
    assert max(seen["poses"]) < 1


def test_the_first_view_of_a_tall_window_holds_the_map_and_the_poses(browser: Any, saved: Path) -> None:
    tall = {"width": 1280, "height": 1600}
    with opened(browser, f"{saved.as_uri()}#frame={quote(viewed.HOSTILE)}", tall, offline=True) as page:
        assert_first_view_holds_everything(page)


def test_a_phone_shows_everything_in_its_width(browser: Any, saved: Path) -> None:
    with opened(browser, saved.as_uri(), PHONE, offline=True, has_touch=True) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
        verdict, stage = (
            page.evaluate(f"document.querySelector('{name}').getBoundingClientRect().top")
            for name in ("#verdict", "#stage")
        )
        assert verdict < 100 < stage
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
            paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
            assert (int(paper[4:].split(",")[0]) > 127) == (scheme == "light")


def test_a_notebook_shows_the_page(browser: Any, saved: Path) -> None:
    with opened(browser, (saved.parent / "notebook.html").as_uri(), LAPTOP, "true", offline=True) as page:
        frame = page.frames[1]
        frame.wait_for_selector(".outcome.good")
        frame.click("#next")
        frame.wait_for_selector(".outcome.bad")
        frame.click("#rows tbody tr")
        frame.wait_for_selector(".outcome.good")
