r"""Train the maps whose answers are put on record by ``answers.py``.

    BIDNERF_DATA=FOLDER BIDNERF_MAPS=FOLDER python benchmarks/answer_maps.py SCENE [SCENE ...]

SCENE is the name of a dataset in the folder ``BIDNERF_DATA``; SCENE@K is the same with half of its training images, drawn with seed
K (1, 2, 3 ...), since what holds for one map of a scene need not hold for another. Each map is trained with the default backend for 1500 steps from
a fixed seed, on one thread, and baked as usual. It is kept in the folder ``BIDNERF_MAPS`` under the name of the scene and a
digest of all that it was made from: the content of the dataset's files, the settings of the training, and ``VERSION``, which
goes up with every change of the code that changes maps. A map that is already there is not trained again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import time
from dataclasses import replace
from pathlib import Path

from _lab import one_thread

from bidnerf_core.datasets import Capture, open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.maps import TrainOptions, train

CONFIG = {"steps": 1500, "seed": 0}
VERSION = 1


def folder_of(variable: str) -> Path:
    """Return the folder that a variable of the environment names."""
    value = os.environ.get(variable)
    if not value:
        raise InputError(f"{variable} is not set, expected a folder")
    return Path(value)


def data_folder(scene: str) -> Path:
    """Return the folder of the dataset of SCENE or SCENE@K."""
    return folder_of("BIDNERF_DATA") / scene.partition("@")[0]


def training_images(scene: str) -> Capture:
    """Return the dataset of SCENE, or that of SCENE@K without the training images that are not in half K."""
    capture, half = open_dataset(data_folder(scene)), scene.partition("@")[2]
    if not half:
        return capture
    train = [place for place, shot in enumerate(capture.shots) if "train" in shot.splits]
    left_out = set(random.Random(int(half)).sample(train, len(train) // 2))
    return replace(capture, shots=[shot for place, shot in enumerate(capture.shots) if place not in left_out])


def map_folder(scene: str) -> Path:
    """Return the folder of a scene's map, whether the map has been trained or not."""
    data = data_folder(scene)
    if not data.is_dir():
        raise InputError(f"{data}: no such folder, expected a dataset; BIDNERF_DATA names the folder of all")
    hashed = hashlib.blake2b(json.dumps([VERSION, CONFIG], sort_keys=True).encode(), digest_size=6)
    for path in sorted(path for path in data.rglob("*") if path.is_file()):
        with path.open("rb") as file:
            hashed.update(str(path.relative_to(data)).encode() + hashlib.file_digest(file, "blake2b").digest())
    return folder_of("BIDNERF_MAPS") / f"{scene}-{hashed.hexdigest()}"


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
                training_images(scene) if "@" in scene else data_folder(scene),
                out=partial,
                config=CONFIG,
                options=TrainOptions(overwrite=True),
            )
            partial.rename(folder)
        print(f"{folder}: {time.process_time() - began:.0f} s of CPU time", flush=True)


if __name__ == "__main__":
    main()
