"""Film a tracked sequence: each image, the map rendered from the pose found, and both blended, as a video (extra `video`).

    python examples/09_film_a_track.py [--map MAP --data DATA] [--every 1] [--out track.mp4]

Where the edges of image and map coincide, the pose is right. Without a map, a textured ground in closed form stands in for one.
"""

import argparse
from pathlib import Path

import av

import bidnerf as bn
from bidnerf.results import overlay
from bidnerf.testing import textured_map
from bidnerf.testing import textured_view as view
from bidnerf_core.datasets import capture_of
from bidnerf_core.geometry import look_at

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--map")
parser.add_argument("--data", help="dataset, folder of images, or video of what the map shows")
parser.add_argument("--every", type=int, default=1, help="film only every n-th frame")
parser.add_argument("--out", default="track.mp4")
given = parser.parse_args()

if given.map:
    scene, sequence = bn.load_map(given.map), given.data
else:
    eyes = [(0.7 - 0.03 * number, 0.4, 1.5) for number in range(3)]
    scene = textured_map(surface=True)
    sequence = capture_of([view(look_at(eye, (0.0, 0.0, 0.0)), str(n)) for n, eye in enumerate(eyes)], Path("ground"))

with av.open(given.out, "w") as film:
    stream = film.add_stream("libx264", rate=10)

    def add(frame, answer):
        picture = overlay(scene, frame, answer.localization)
        if not stream.codec_context.is_open:
            stream.height, stream.width = (side // 2 * 2 for side in picture.shape[:2])  # the codec wants even sides
        film.mux(stream.encode(av.VideoFrame.from_ndarray(picture[: stream.height, : stream.width])))

    path = bn.track(scene, sequence, every=given.every, each=add)
    film.mux(stream.encode())
print(f"{given.out}: success in {len(path.accepted)} of {len(path)} frames")
