"""Track images while a camera writes them into a folder, with one line of JSON for each: a bridge to a phone or a robot.

    python examples/07_track_as_images_arrive.py [--map MAP --folder DIR --hfov DEGREES]

An image is read once its size no longer changes, and five seconds without a new one end the program. Without a map, a ground in
closed form stands in for one, and images of a flight over it arrive.
"""

import argparse
import json
import math
import threading
import time
from pathlib import Path

import imageio.v3 as iio

import bidnerf as bn
from bidnerf.testing import textured_map, view
from bidnerf_core.geometry import look_at

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--map")
parser.add_argument("--folder", type=Path, default=Path("arriving"))
parser.add_argument("--hfov", type=float, default=52.4, help="horizontal field of view of the camera, in degrees")
given = parser.parse_args()


def record(angles=(0.6, 0.635, 0.67, 0.705)):
    for angle in angles:
        frame = view(look_at((0.75 * math.cos(angle), 0.75 * math.sin(angle), 1.5), (0.0, 0.0, 0.0))).frame
        iio.imwrite(given.folder / f"{angle:.3f}.png", (255 * frame.rgb).round().byte().numpy())


given.folder.mkdir(exist_ok=True)
tracker = bn.Tracker(bn.Localizer(bn.load_map(given.map) if given.map else textured_map(surface=True)))
if given.map is None:
    threading.Thread(target=record).start()
sizes, converged, latest = {}, [], time.monotonic()
while time.monotonic() < latest + 5:
    for image in (image for image in sorted(given.folder.glob("*.png")) if sizes.get(image) != "done"):
        if sizes.get(image) == (size := image.stat().st_size) > 0:
            found = tracker(bn.Frame.open(image, hfov=given.hfov), time=image.stat().st_mtime)
            print(json.dumps({"image": image.name, "pose": found.T_world_camera.matrix().tolist()}), flush=True)
            converged, latest, size = [*converged, found.converged], time.monotonic(), "done"
        sizes[image] = size
    time.sleep(0.05)
print(f"success in {sum(converged)} of {len(converged)} images")
