"""Localize with a backend chosen by name among those installed; a stored map records its own.

    python examples/03_backend_by_name.py [vanilla] [--steps 200]

Nothing here depends on a particular backend: a plugin's name works as well, and an unknown name ends with a one-line error.
"""

import argparse
import sys
import tempfile

import bidnerf as bn
from bidnerf.results import pose_error
from bidnerf.scenes import closed_form_data
from bidnerf_core.geometry import perturb
from bidnerf_core.registry import list_plugins

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("backend", nargs="?", default="hashgrid")
parser.add_argument("--steps", type=int, default=200)
parser.add_argument("--descent", type=int, default=120, help="steps of the localizer")
given = parser.parse_args()

for info in list_plugins("backends"):  # reads only metadata, without importing any
    print(f"{info.name}: {info.fault or info.summary} ({info.distribution} {info.version})")

data = closed_form_data("demo:object")
with tempfile.TemporaryDirectory() as folder:  # as `bidnerf train` and `bidnerf localize` do it
    try:
        bn.train(data, given.backend, folder, {"steps": given.steps}, bake=False)
    except bn.InputError as error:
        sys.exit(str(error))
    scene = bn.load_map(folder)

(unseen,) = data.views("test", ["0003"])
start = perturb(unseen.T_ref_camera, translation=0.4, rotation_deg=10, seed=0)
localizer = bn.Localizer(scene, "bid", {"rays": 512, "max_steps": given.descent})
found = localizer(unseen.frame, start)
error = pose_error(found.T_world_camera, unseen.T_ref_camera)
print(f"{scene.info.backend}: off by {error} after {found.steps} steps in {found.seconds:.1f} s")
