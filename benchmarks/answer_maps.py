r"""Train the maps whose answers are put on record by ``answers.py``.

    BIDNERF_DATA=FOLDER BIDNERF_MAPS=FOLDER python benchmarks/answer_maps.py SCENE [SCENE ...]

SCENE is the name of a dataset in the folder ``BIDNERF_DATA``; SCENE@K is the same with half of its training images, drawn with seed
K (1, 2, 3 ...), since what holds for one map of a scene need not hold for another; and SCENE@new is the same split anew, so that what is
held out are images to which no answers were on record when thresholds were set. Each map is trained with the default backend for 1500 steps from
a fixed seed, on one thread, and baked as usual. It is kept in the folder ``BIDNERF_MAPS`` under the name of the scene and a
digest of all that it was made from: the content of the dataset's files, the settings of the training, and ``VERSION``, which
goes up with every change of the code that changes maps. A map that is already there is not trained again.
"""

from __future__ import annotations

import argparse
import time

from _lab import CONFIG, capture_of, data_folder, map_folder, one_thread

from bidnerf_core.maps import TrainOptions, train


def main() -> None:
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("scenes", nargs="+", metavar="SCENE")
    one_thread()
    for scene in found.parse_args().scenes:
        folder, began = map_folder(scene), time.process_time()
        if not folder.exists():
            # An interrupted training leaves nothing that could be taken for a finished map.
            partial = folder.with_name(f"{folder.name}.partial")
            train(
                capture_of(scene) if "@" in scene else data_folder(scene),
                out=partial,
                config=CONFIG,
                options=TrainOptions(overwrite=True),
            )
            partial.rename(folder)
        print(f"{folder}: {time.process_time() - began:.0f} s of CPU time", flush=True)


if __name__ == "__main__":
    main()
