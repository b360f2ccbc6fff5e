"""Train a small map in memory, and find one camera in it from a bad start.

python examples/01_find_a_camera.py [--backend hashgrid] [--steps 600]
"""

import argparse

import bidnerf as bn
from bidnerf.results import pose_error
from bidnerf.scenes import closed_form_data
from bidnerf_core.geometry import perturb
from bidnerf_core.progress import Progress

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--backend", default="hashgrid")
parser.add_argument("--steps", type=int, default=600)
parser.add_argument("--descent", type=int, default=120, help="steps of the localizer")
given = parser.parse_args()

# A scene in closed form stands in for your own images, which open_dataset("FOLDER") opens.
data = closed_form_data("demo:object")


def report(progress: Progress) -> None:
    if progress.done % 100 == 0:
        print(f"{progress.stage}: {progress.done} of {progress.total} {progress.unit}")


scene = bn.train(data, given.backend, config={"steps": given.steps}, bake=False, progress=report)

(unseen,) = data.views("test", ["0003"])
start = perturb(unseen.T_ref_camera, translation=0.4, rotation_deg=10, seed=0)
localizer = bn.Localizer(scene, "bid", {"rays": 512, "max_steps": given.descent})
found = localizer(unseen.frame, start)

for what, pose in (("start", start), ("found", found.T_world_camera)):
    print(f"{what}: off by {pose_error(pose, unseen.T_ref_camera)}")
