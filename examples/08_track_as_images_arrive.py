"""Track images while a camera writes them into a folder, with one line of JSON for each: a bridge to a phone or a robot.

    python examples/08_track_as_images_arrive.py [--map MAP --folder DIR --hfov DEGREES]

An image is read once its size no longer changes. Without a map, a ground in closed form stands in for one.
"""

import argparse
import json
import threading
import time
from pathlib import Path

import imageio.v3 as iio

import bidnerf as bn
from bidnerf.testing import textured_map, textured_view
from bidnerf_core.geometry import look_at

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--map")
parser.add_argument("--folder", type=Path, default=Path("arriving"))
parser.add_argument("--hfov", type=float, default=52.4, help="horizontal field of view of the camera, in degrees")
given = parser.parse_args()
given.folder.mkdir(exist_ok=True)


def record():
    for number in range(0 if given.map else 4):
        pose = look_at((0.7 - 0.03 * number, 0.4, 1.5), (0.0, 0.0, 0.0))
        iio.imwrite(given.folder / f"{number}.png", (255 * textured_view(pose).frame.rgb).round().byte().numpy())


tracker = bn.Tracker(bn.Localizer(bn.load_map(given.map) if given.map else textured_map(surface=True)))
threading.Thread(target=record).start()
sizes, converged, latest = {}, [], time.monotonic()
while time.monotonic() < latest + 5:  # seconds without a new image end the program
    for image in (image for image in sorted(given.folder.glob("*.png")) if sizes.get(image) != "done"):
        if sizes.get(image) == (size := image.stat().st_size) > 0:
            found = tracker(bn.Frame.open(image, hfov=given.hfov), time=image.stat().st_mtime)
            print(json.dumps({"image": image.name, "pose": found.T_world_camera.matrix().tolist()}), flush=True)
            converged, latest, size = [*converged, found.converged], time.monotonic(), "done"
        sizes[image] = size
    time.sleep(0.05)
print(f"success in {sum(converged)} of {len(converged)} images")
