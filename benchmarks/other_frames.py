r"""Write datasets of the same scenes whose held-out frames are not on record, for answers that nothing was fitted to.

    BIDNERF_DATA=FOLDER python benchmarks/other_frames.py OUT

For each scene of ``answers.py``, OUT gets a folder of the same name without the frames that ``results/answers.rows.jsonl.xz``
has answers to. Of the other frames of the training split, every second one is for training; the rest (where it has depth if the
test split has), and what is left of the test split, is held out. Maps of OUT (``answer_maps.py`` with ``BIDNERF_DATA=OUT`` and another ``BIDNERF_MAPS``) thus see half of
the frames. The answers to the held-out frames then show what thresholds and confidences are worth that were set before.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

from _lab import RESULTS
from answer_maps import folder_of
from answers import PLANES, answers_of, read_rows


def split_again(source: Path, out: Path, on_record: set[str]) -> None:
    """Write a dataset in the format of ``transforms.json`` without the frames ``on_record``, split anew."""
    old: dict[str, dict[str, Any]] = {
        split: json.loads((source / f"transforms_{split}.json").read_text()) for split in ("train", "test")
    }
    train = old["train"]["frames"]
    left = [frame for frame in old["test"]["frames"] if Path(frame["file_path"]).stem not in on_record]
    # Otherwise, the training split lacks the depth of the test split.
    if train[0].keys() == old["test"]["frames"][0].keys():
        left += train[1::2]
    out.mkdir(parents=True)
    for split, frames in {"train": train[::2], "test": left}.items():
        (out / f"transforms_{split}.json").write_text(json.dumps(old[split] | {"frames": frames}))
    for folder in {Path(frame["file_path"]).parts[0] for some in old.values() for frame in some["frames"]} | {"depth"}:
        if (source / folder).is_dir():
            shutil.copytree(source / folder, out / folder)


def without_frames(source: Path, out: Path, on_record: set[str]) -> None:
    """Copy the files of a capture but for those of the frames ``on_record``, numbered at the end of their names."""
    numbers = {name.split("_")[-1] for name in on_record}
    out.mkdir(parents=True)
    for path in source.iterdir():
        if path.is_file() and path.stem.split("_")[-1] not in numbers:
            shutil.copy2(path, out)


def main() -> None:
    found = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    found.add_argument("out", type=Path)
    out: Path = found.parse_args().out
    on_record: dict[str, set[str]] = {}
    for scene, _, condition, frame in answers_of(read_rows(RESULTS / "answers.rows.jsonl.xz")):
        if scene != PLANES and condition != "other scene":
            on_record.setdefault(scene, set()).add(frame)
    for scene, frames in on_record.items():
        source = folder_of("BIDNERF_DATA") / scene
        how = split_again if (source / "transforms_train.json").exists() else without_frames
        how(source, out / scene, frames)
        print(f"{out / scene}: without {len(frames)} frames", flush=True)


if __name__ == "__main__":
    main()
