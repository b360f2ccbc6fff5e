"""Wrong conventions of camera poses: which are refused, with which remedy, and how often right poses are.

    python benchmarks/pose_conventions.py DATA [DATA ...] [--most 60] [--name pose_conventions]

The poses of each capture's training images (evenly chosen, at most ``--most``) are changed as programs and people change them by
mistake, and checked as ``bidnerf train`` checks them before it trains. Recorded for each mistake are the pairs of photos with which
the poses agree, whether they are refused, what the message says, and whether the poses are right if it is followed. Right poses are
checked for several parts of each capture. Nothing is trained. Each capture is a row of ``NAME.rows.jsonl``, from which an interrupted run goes on.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import _lab
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf import SE3, open_dataset
from bidnerf_core.captures import pose_contradiction
from bidnerf_core.mapping import SIFT, ImageKeypoints, posed_keypoints

FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
Change = Callable[[SE3], SE3]


def opengl(change: Change) -> Change:
    """Return a change of matrices in a file with OpenGL axes, which a reader converts."""
    return lambda T: axes(change(axes(T, FLIP)), FLIP)


def axes(T: SE3, A: Tensor) -> SE3:
    return SE3(T.rotation @ A, T.translation)


def moved(T: SE3, position: Tensor) -> SE3:
    return SE3(T.rotation, position)


def times(T: SE3, D: Tensor) -> Tensor:
    """Return the positions multiplied by a matrix."""
    return T.translation @ D.mT


def diagonal(x: float, y: float, z: float) -> Tensor:
    return torch.diag(torch.tensor([x, y, z], dtype=torch.float64))


def turn(axis: str, degrees: float) -> Tensor:
    return torch.from_numpy(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())


def reordered(T: SE3, *order: int) -> SE3:
    quaternion = rotation_matrix_to_quaternion(T.rotation.contiguous())
    return SE3(quaternion_to_rotation_matrix(quaternion[:, list(order)]), T.translation)


def euler(T: SE3) -> SE3:
    angles = Rotation.from_matrix(T.rotation.numpy()).as_euler("xyz")
    return SE3(torch.from_numpy(Rotation.from_euler("zyx", angles).as_matrix()), T.translation)


def mirrored(T: SE3, S: Tensor) -> SE3:
    return SE3(S @ T.rotation @ S, times(T, S))


def text_order(T: SE3) -> SE3:
    return T[sorted(range(len(T.translation)), key=str)]


def shuffled(T: SE3) -> SE3:
    return T[torch.randperm(len(T.translation), generator=torch.Generator().manual_seed(0))]


def shifted(T: SE3, by: int) -> SE3:
    count = len(T.translation)
    return T[(torch.arange(count) + by).clamp(0, count - 1)]


def transposed(T: SE3) -> SE3:
    return SE3(T.rotation.mT, T.translation)


def rotated(T: SE3, factor: Tensor, sign: int) -> SE3:
    """Return the poses with positions multiplied by a rotation of each."""
    return moved(T, sign * (factor @ T.translation[..., None])[..., 0])


def increments(T: SE3) -> SE3:
    """Return the motion since the image before as the pose."""
    return SE3.cat([T[:1], T[:-1].inverse() @ T[1:]])


WRONG: dict[str, Change] = {
    "OpenCV's axes for OpenGL's": lambda T: axes(T, FLIP),
    "inverses": opengl(lambda T: T.inverse()),
    "inverses with OpenCV's axes": lambda T: T.inverse(),
    "rotations transposed": opengl(transposed),
    "rotations transposed, OpenCV": transposed,
    "translations of inverses": opengl(lambda T: rotated(T, T.rotation.mT, -1)),
    "inverses without the minus": opengl(lambda T: SE3(T.rotation.mT, -T.inverse().translation)),
    "positions negated": lambda T: moved(T, -T.translation),
    "x of positions reversed": lambda T: moved(T, times(T, diagonal(-1, 1, 1))),
    "y of positions reversed": lambda T: moved(T, times(T, diagonal(1, -1, 1))),
    "z of positions doubled": lambda T: moved(T, times(T, diagonal(1, 1, 2))),
    "y and z of positions swapped": lambda T: moved(T, T.translation[:, [0, 2, 1]]),
    "positions in a world turned by 30 degrees": lambda T: moved(T, times(T, turn("x", 30))),
    "quaternions w x y z for x y z w": lambda T: reordered(T, 1, 2, 3, 0),
    "quaternions x y z w for w x y z": lambda T: reordered(T, 3, 0, 1, 2),
    "quaternions x y z w for w x y z, world to camera": lambda T: reordered(T.inverse(), 1, 2, 3, 0).inverse(),
    "quaternions w x y z for x y z w, world to camera": lambda T: reordered(T.inverse(), 3, 0, 1, 2).inverse(),
    "each of the next image": lambda T: shifted(T, 1),
    "each of the image before the previous one": lambda T: shifted(T, -2),
    "reverse order": lambda T: T[list(range(len(T.translation)))[::-1]],
    "order of numbers as text": text_order,
    "random order": shuffled,
    "left-handed, z reversed": opengl(lambda T: mirrored(T, diagonal(1, 1, -1))),
    "left-handed, y reversed": opengl(lambda T: mirrored(T, diagonal(1, -1, 1))),
    "axes of ROS": lambda T: axes(T, torch.tensor([[0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=torch.float64)),
    "cameras turned by 90 degrees": lambda T: axes(T, turn("z", 90)),
    "angles applied in the reverse order": euler,
    "increments as poses": increments,
    "angles halved": lambda T: SE3(
        torch.from_numpy(Rotation.from_rotvec(Rotation.from_matrix(T.rotation.numpy()).as_rotvec() / 2).as_matrix()),
        T.translation,
    ),
}
PARTS: dict[str, Callable[[int], Sequence[int]]] = {
    "all": lambda n: range(n),
    "first half": lambda n: range(n // 2),
    "second half": lambda n: range(n // 2, n),
    "every second": lambda n: range(0, n, 2),
    "every third": lambda n: range(0, n, 3),
    "last quarter": lambda n: range(3 * n // 4, n),
}
"""Parts of a capture whose right poses are checked."""


def remedied(found: SE3, truth: SE3) -> bool:
    """Return whether poses are right up to a similarity, for at least four of five successive pairs that have poses."""
    step, right = found[:-1].inverse() @ found[1:], truth[:-1].inverse() @ truth[1:]
    known = step.translation.isfinite().all(-1)
    angle = (step.rotation.mT @ right.rotation).diagonal(dim1=-2, dim2=-1).sum(-1)
    turned = ((angle - 1) / 2).clamp(-1, 1).acos() < math.radians(0.5)
    along = torch.nn.functional.cosine_similarity(step.translation, right.translation, dim=-1)
    return float((turned & (along > math.cos(math.radians(5))))[known].double().mean()) > 0.8


def with_poses(images: Sequence[ImageKeypoints], T: SE3) -> list[ImageKeypoints]:
    return [replace(image, T_ref_camera=T[i]) for i, image in enumerate(images)]


def checked(images: Sequence[ImageKeypoints], T: SE3, truth: SE3) -> dict[str, Any]:
    began = time.process_time()
    found = pose_contradiction(with_poses(images, T))
    answer: dict[str, Any] = {"refused": found is not None, "cpu_seconds": time.process_time() - began}
    if found is not None:
        answer |= {"agreeing": found.agreeing_as_given, "pairs": found.pairs}
        if found.reading is not None:
            answer |= {
                "says": found.reading.clause,
                "then_agreeing": found.agreeing,
                "remedy_right": remedied(found.reading.understand(T), truth),
            }
    return answer


def measured(data: Path, most: int) -> dict[str, Any]:
    dataset = open_dataset(data)
    names = dataset.frame_names("train")
    some = names[:: max(1, -(-len(names) // most))]
    views = dataset.views("train", some)
    images = posed_keypoints(views, SIFT)
    truth = SE3.stack([image.T_ref_camera for image in images])
    right = {}
    for part, chosen in PARTS.items():
        index = list(chosen(len(images)))
        right[part] = checked([images[i] for i in index], truth[index], truth[index])
    wrong = {mistake: checked(images, change(truth), truth) for mistake, change in WRONG.items()}
    return {"images": len(images), "right": right, "wrong": wrong}


def summary(rows: dict[str, Any]) -> dict[str, Any]:
    wrong = [found for row in rows.values() for found in row["wrong"].values()]
    right = [found for row in rows.values() for found in row["right"].values()]
    return {
        "wrong": len(wrong),
        "trained_in_silence": sum(not found["refused"] for found in wrong),
        "with_a_remedy": sum("says" in found for found in wrong),
        "with_the_right_remedy": sum(found.get("remedy_right", False) for found in wrong),
        "right": len(right),
        "right_refused": sum(found["refused"] for found in right),
    }


def condensed(row: dict[str, Any]) -> dict[str, Any]:
    """Return a capture's row without what its messages say and how long they took."""
    kept = ("refused", "agreeing", "pairs", "then_agreeing", "remedy_right")
    wrong = {mistake: {key: found[key] for key in kept if key in found} for mistake, found in row["wrong"].items()}
    return {
        "images": row["images"],
        "right_refused": [part for part, found in row["right"].items() if found["refused"]],
        "wrong": wrong,
    }


def main() -> None:
    arguments = _lab.parser(__doc__, "pose_conventions")
    arguments.add_argument("data", nargs="+", type=Path, metavar="DATA")
    arguments.add_argument("--most", type=int, default=60)
    given = arguments.parse_args()
    _lab.one_thread()
    file = _lab.RESULTS / f"{given.name}.rows.jsonl"
    known = [json.loads(row) for row in file.read_text().splitlines()] if file.exists() else []
    rows = {json.dumps(row["key"]): row["found"] for row in known}
    results: dict[str, Any] = {}
    for data in given.data:
        key = json.dumps([data.name, given.most, sorted(WRONG), sorted(PARTS)])
        if key not in rows:
            rows[key] = measured(data, given.most)
            with file.open("a") as stream:
                stream.write(json.dumps({"key": json.loads(key), "found": rows[key]}) + "\n")
        results[data.name] = rows[key]
        for kind in ("right", "wrong"):
            for name, found in rows[key][kind].items():
                print(f"{data.name:16} {name:50} {found}", flush=True)
    print(summary(results))
    captures = {name: condensed(row) for name, row in results.items()}
    _lab.record(given.name, {"summary": summary(results), **captures})


if __name__ == "__main__":
    main()
