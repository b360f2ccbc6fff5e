"""Localize with a backend chosen by name among those installed; a stored map records its own.

    python examples/03_backend_by_name.py [vanilla] [--steps 200]

Nothing here depends on a particular backend: a plugin's name works as well, and an unknown name ends with a one-line error.
"""

import argparse
import dataclasses
import sys
import tempfile
from pathlib import Path

from bidnerf_core import Intrinsics, Localizer, list_plugins, load_backend, load_map
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.io.json import to_plain
from bidnerf_core.localization import settings_of
from bidnerf_core.maps.description import MapInfo
from bidnerf_core.maps.files import save_map
from bidnerf_core.results.errors import pose_error
from bidnerf_core.scenes.demo import demo_object, orbit, views
from bidnerf_core.training import Silent, TrainingState

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("backend", nargs="?", default="hashgrid")
parser.add_argument("--steps", type=int, default=200)
parser.add_argument("--descent", type=int, default=120, help="steps of the localizer")
given = parser.parse_args()

for info in list_plugins("backends"):  # reads only metadata, without importing any
    print(f"{info.name}: {info.fault or info.summary} ({info.distribution} {info.version})")
try:
    backend = load_backend(given.backend)
except InputError as error:
    sys.exit(str(error))

scene, camera = demo_object(), Intrinsics(fx=90.0, fy=90.0, cx=32.0, cy=32.0, width=64, height=64)
config = dataclasses.replace(backend.config_type(), steps=given.steps)
field = backend.build(config, scene.bounds)
backend.train(field, views(scene, camera, orbit(radius=3.5, count=40)), config, Silent())

with tempfile.TemporaryDirectory() as folder:  # as `bidnerf train` and `bidnerf localize` do it
    state = TrainingState(given.steps, dict(field.state_dict()), {})
    description = MapInfo(given.backend, to_plain(config), scene.bounds, given.steps, complete=True)
    save_map(Path(folder), description, state)
    stored = load_map(Path(folder))

(unseen,) = views(scene, camera, orbit(radius=3.5, count=1, elevation=(20, 40), seed=1))
start = perturb(unseen.T_ref_camera, translation=0.4, rotation_deg=10, seed=0)
localizer = Localizer(stored, "bid", settings_of("bid", {"rays": 512, "max_steps": given.descent}))
found = localizer(unseen.frame, start)
error = pose_error(found.T_world_camera, unseen.T_ref_camera)
print(
    f"{stored.info.backend}: off by {float(error.translation):.3f} m and {float(error.rotation_deg):.2f} degrees"
    f" after {found.steps} steps of {1000 * found.seconds / found.steps:.0f} ms"
)
