"""Several images whose poses are known relative to each other (from odometry, say) are localized together.

    python examples/02_rig_of_views.py [--backend hashgrid] [--steps 600]

The rays are divided among the images, so a step costs the same; the pose found is that of the last camera.
"""

import argparse
import dataclasses

from bidnerf_core import Intrinsics, Localizer, Map, load_backend
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.localization import settings_of
from bidnerf_core.maps.description import MapInfo
from bidnerf_core.results.errors import pose_error
from bidnerf_core.scenes.demo import demo_object, look_at, orbit, views
from bidnerf_core.training import Silent

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--backend", default="hashgrid")
parser.add_argument("--steps", type=int, default=600)
parser.add_argument("--descent", type=int, default=120, help="steps of the localizer")
given = parser.parse_args()

scene, camera = demo_object(), Intrinsics(fx=90.0, fy=90.0, cx=32.0, cy=32.0, width=64, height=64)
backend = load_backend(given.backend)
config = dataclasses.replace(backend.config_type(), steps=given.steps)
field = backend.build(config, scene.bounds)
backend.train(field, views(scene, camera, orbit(radius=3.5, count=40)), config, Silent())
field.requires_grad_(False)
map = Map(MapInfo(given.backend, {}, scene.bounds, given.steps, complete=True), field)
localizer = Localizer(map, "bid", settings_of("bid", {"rays": 512, "max_steps": given.descent}))

# Four cameras along an arc. Only their relative poses are used; the map never saw these images.
arc = [
    look_at(eye, (0, 0, 0)) for eye in ((3.2, -0.9, 1.4), (3.3, -0.3, 1.4), (3.3, 0.3, 1.4), (3.2, 0.9, 1.4))
]
sequence = views(scene, camera, arc)
start = perturb(arc[-1], translation=0.5, rotation_deg=12, seed=0)

for used in (sequence[-1:], sequence):
    found = localizer(used, start)
    error = pose_error(found.T_world_camera, arc[-1])
    print(
        f"{len(used)} view(s): off by {float(error.translation):.3f} m, {float(error.rotation_deg):.2f} degrees"
    )
