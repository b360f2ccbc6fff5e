"""Several images whose poses are known relative to each other (from odometry, say) are localized together.

    python examples/02_rig_of_views.py [--backend hashgrid] [--steps 600]

The rays are divided among the images, so a step costs the same; the pose found is that of the last camera.
"""

import argparse
import math

import bidnerf as bn
from bidnerf.results import pose_error
from bidnerf.scenes import closed_form_data, demo_object, views
from bidnerf_core.camera import Intrinsics
from bidnerf_core.geometry import look_at, perturb

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--backend", default="hashgrid")
parser.add_argument("--steps", type=int, default=600)
parser.add_argument("--descent", type=int, default=120, help="steps of the localizer")
given = parser.parse_args()

scene = bn.train(closed_form_data("demo:object"), given.backend, config={"steps": given.steps}, bake=False)
localizer = bn.Localizer(scene, "bid", {"rays": 512, "max_steps": given.descent})

# Four cameras along an arc, ten degrees apart. Only their relative poses are used; the map never saw these images.
angles = (math.radians(degrees) for degrees in (30, 20, 10, 0))
poses = [look_at((3 * math.cos(a), 3 * math.sin(a), 1.8), (0, 0, 0)) for a in angles]
rig = views(demo_object(), Intrinsics(175, 175, 64, 64, 128, 128), poses)
true = poses[-1]
start = perturb(true, translation=0.5, rotation_deg=12, seed=0)

for used in (rig[-1:], rig):
    found = localizer(used, start)
    print(f"{len(used)} view(s): off by {pose_error(found.T_world_camera, true)}")
