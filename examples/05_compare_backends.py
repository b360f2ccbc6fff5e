"""Compare all installed backends on one scene, from the same starts: success, steps, time and memory.

    python examples/05_compare_backends.py [--backends hashgrid vanilla ...] [--steps 600] [--trials 4]
    python examples/05_compare_backends.py --data DATA --maps MAP MAP ...

Without maps, each backend is trained briefly, in memory, on a scene in closed form. `bidnerf compare` draws a picture as well.
"""

import argparse

import bidnerf as bn
from bidnerf.scenes import closed_form_data
from bidnerf_core.registry import list_plugins


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--maps", nargs="+", default=[])
    parser.add_argument("--data", help="dataset of what the maps show")
    parser.add_argument("--backends", nargs="+", help="backends to train (default: all that are installed)")
    parser.add_argument("--steps", type=int, default=600, help="of each training")
    parser.add_argument("--descent", type=int, default=120, help="steps of the localizer")
    parser.add_argument("--trials", type=int, default=4, help="starts")
    given = parser.parse_args()
    if given.maps and given.data is None:
        parser.error("--maps needs --data, a dataset of what they show")

    data = given.data or closed_form_data("demo:object")
    backends = given.backends or [info.name for info in list_plugins("backends") if info.fault is None]
    scenes = {folder: folder for folder in given.maps} or {
        name: bn.train(data, name, config={"steps": given.steps}, bake=False) for name in backends
    }
    settings = {"rays": 512, "max_steps": given.descent}
    plan = bn.Plan(protocol="bid", sizes=[0.5], method="bid", config=settings, trials=given.trials)
    print(bn.compare(scenes, data, plan))


if __name__ == "__main__":  # maps in folders are compared in processes of their own, which import this file
    main()
