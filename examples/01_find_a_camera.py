"""Train a small map in memory, and find one camera in it from a bad start.

python examples/01_find_a_camera.py [--backend hashgrid] [--steps 600]
"""

import argparse
import dataclasses

from bidnerf_core import Intrinsics, Localizer, Map, load_backend
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.localization import settings_of
from bidnerf_core.maps.description import MapInfo
from bidnerf_core.results.errors import pose_error
from bidnerf_core.scenes.demo import demo_object, orbit, views
from bidnerf_core.training import Silent

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--backend", default="hashgrid")
parser.add_argument("--steps", type=int, default=600)
parser.add_argument("--descent", type=int, default=120, help="steps of the localizer")
given = parser.parse_args()

# A scene in closed form stands in for your own images: open_dataset(...).views("train") gives the same kind of list.
scene, camera = demo_object(), Intrinsics(fx=90.0, fy=90.0, cx=32.0, cy=32.0, width=64, height=64)
seen = views(scene, camera, orbit(radius=3.5, count=40))
(unseen,) = views(scene, camera, orbit(radius=3.5, count=1, elevation=(20, 40), seed=1))

backend = load_backend(given.backend)
config = dataclasses.replace(backend.config_type(), steps=given.steps)
field = backend.build(config, scene.bounds)
backend.train(field, seen, config, Silent())
field.requires_grad_(False)

# load_map(folder) gives the same for a map that 'bidnerf train' stored.
map = Map(MapInfo(given.backend, {}, scene.bounds, given.steps, complete=True), field)
localizer = Localizer(map, "bid", settings_of("bid", {"rays": 512, "max_steps": given.descent}))
start = perturb(unseen.T_ref_camera, translation=0.4, rotation_deg=10, seed=0)
found = localizer(unseen.frame, start)

for what, pose in (("start", start), ("found", found.T_world_camera)):
    error = pose_error(pose, unseen.T_ref_camera)
    print(f"{what}: off by {float(error.translation):.3f} m and {float(error.rotation_deg):.2f} degrees")
