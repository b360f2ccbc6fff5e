"""Soft coloured balls: a field of your own in twenty lines, registered, listed, trained and localized against.

    python examples/04_register_your_own.py [--steps 300]

A backend is found through an entry point, a line of metadata that `pip install` writes. Here a throw-away distribution is
laid out as pip would install it, so that nothing has to be installed; plugins/bidnerf-template is a real one.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch

from bidnerf_core import Intrinsics, Localizer, Map, list_plugins, load_backend
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.fields.contract import FieldValues, device_of
from bidnerf_core.fields.sampling import Stratified
from bidnerf_core.localization import settings_of
from bidnerf_core.maps.description import MapInfo
from bidnerf_core.results.errors import pose_error
from bidnerf_core.scenes.demo import demo_object, orbit, views
from bidnerf_core.training import Silent, Supervision, SupervisionConfig


@dataclass(frozen=True)
class BallsConfig(SupervisionConfig):
    balls: int = 64
    steps: int = 300


class Balls(torch.nn.Module):
    def __init__(self, config, bounds):
        super().__init__()
        self.bounds, self.side, self.sampler = bounds, max(bounds.size), Stratified(32)
        places = torch.rand((config.balls, 3), generator=torch.Generator().manual_seed(0))
        self.centres = torch.nn.Parameter(
            (places - 0.5) * torch.tensor(bounds.size)
            + torch.tensor(bounds.lower) / 2
            + torch.tensor(bounds.upper) / 2
        )
        self.look = torch.nn.Parameter(torch.zeros(config.balls, 5))  # rgb, density, size; before activation

    def query(self, positions, directions):
        rgb, density, size = self.look.split([3, 1, 1], dim=-1)
        squared = (positions[..., None, :] - self.centres).square().sum(-1)
        each = torch.exp(density[:, 0] - squared / (0.08 * self.side * size[:, 0].exp()) ** 2)
        shares = each / (each.sum(-1, keepdim=True) + 1e-9)
        return FieldValues(20 / self.side * each.sum(-1), shares @ rgb.sigmoid())


class BallsBackend:
    summary, config_type, build = "soft coloured balls", BallsConfig, staticmethod(Balls)

    def train(self, field, views, config, report):
        supervision = Supervision(views, field.bounds, config, device_of(field))

        def outcome(step, generator):
            return supervision.step(field, 256, generator)

        groups = [{"params": list(field.parameters()), "lr": 0.03}]
        supervision.fit(field, groups, outcome, config.steps, report)


backend = BallsBackend()


def register(folder: Path) -> None:
    """Write what `pip install` would, for a distribution whose pyproject.toml declares an entry point."""
    info = folder / "soft_balls-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: soft-balls\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text(f"[bidnerf.backends]\nballs = {Path(__file__).stem}:backend\n")
    sys.path.insert(0, str(folder))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--descent", type=int, default=150, help="steps of the localizer")
    given = parser.parse_args()
    scene, camera = demo_object(), Intrinsics(fx=90.0, fy=90.0, cx=32.0, cy=32.0, width=64, height=64)
    with tempfile.TemporaryDirectory() as folder:
        register(Path(folder))
        print(", ".join(f"{info.name} ({info.distribution})" for info in list_plugins("backends")))
        mine = load_backend("balls")
    config = mine.config_type(steps=given.steps)
    field = mine.build(config, scene.bounds)
    mine.train(field, views(scene, camera, orbit(radius=3.5, count=40)), config, Silent())
    field.requires_grad_(False)

    (unseen,) = views(scene, camera, orbit(radius=3.5, count=1, elevation=(20, 40), seed=1))
    start = perturb(unseen.T_ref_camera, translation=0.4, rotation_deg=10, seed=0)
    map = Map(MapInfo("balls", {}, scene.bounds, given.steps, complete=True), field)
    localizer = Localizer(map, "bid", settings_of("bid", {"rays": 256, "max_steps": given.descent}))
    found = localizer(unseen.frame, start)
    for what, pose in (("start", start), ("found", found.T_world_camera)):
        error = pose_error(pose, unseen.T_ref_camera)
        print(f"{what}: off by {float(error.translation):.3f} m and {float(error.rotation_deg):.2f} degrees")


if __name__ == "__main__":
    main()
