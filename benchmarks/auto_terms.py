r"""Contribution of each part of method ``auto``: landmarks, the surface, rendered rays, with and without depth.

    python benchmarks/auto_terms.py SCENE [SCENE ...] [--rgb] --name auto_terms

No start is given. Maps need landmarks (``bidnerf train`` and ``bidnerf bake --data`` build them). Finished frames are kept, so
that an interrupted run resumes where it stopped. Without depth, the surface alone takes many seconds per image; ``--slow``
tries that as well.
"""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from typing import Any

from _lab import (
    RESULTS,
    RowStore,
    Scene,
    answer,
    cpu_seconds,
    judgement,
    line,
    modes,
    one_thread,
    parser,
    rates,
    record,
)

from bidnerf import Localizer
from bidnerf_core.localization import settings_of

SLOW = "surface alone"
VARIANTS: dict[str, dict[str, Any]] = {
    SLOW: {"landmarks": False},
    "landmarks alone": {"fused_rays": 0},
    "all": {},
}


def scene_results(scene: Scene, given: Namespace, store: RowStore) -> dict[str, Any]:
    """Try all variants on the frames of one scene, as RGB and, where there is depth, as RGB-D."""
    found: dict[str, Any] = {}
    for mode, views in modes(scene.views(given.tuning_frames, given.frames), given.modes).items():
        for label, settings in VARIANTS.items():
            if label == SLOW and mode == "RGB" and not given.slow:
                continue
            localizer = Localizer(scene.map, "auto", settings_of("auto", settings))
            kind = f"{mode}, {label}"
            rows = [
                store.get([*scene.key, kind, view.frame.name], partial(answer, partial(localizer, view.frame), view))
                for view in views
            ]
            found[kind] = rates(rows) | judgement(rows) | cpu_seconds(rows)
            print(line(f"{scene.name} {kind}", rows), flush=True)
    return {
        "landmarks": len(scene.map.landmarks or ()),
        "colour_noise": scene.map.colour_noise,
        "variants": found,
    }


def main() -> None:
    arguments = parser(__doc__, "auto_terms", scenes=True)
    arguments.add_argument("--slow", action="store_true", help="try the surface alone without depth, too")
    arguments.add_argument("--rgb", dest="modes", action="store_const", const=("RGB",), default=("RGB", "RGB-D"))
    given = arguments.parse_args()
    one_thread()
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store:
        scenes = map(Scene.open, given.scenes)
        record(
            given.name,
            {s.name: scene_results(s, given, store) for s in scenes},
        )


if __name__ == "__main__":
    main()
