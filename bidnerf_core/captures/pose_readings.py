"""Readings of camera poses: what given matrices would mean under another convention, or after another common mistake.

Each reading is a transformation of all poses of a capture: of camera axes, full or partial inverses, quaternion orders,
left-handed worlds, axes of the positions, and the order of the images.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial

import torch
from jaxtyping import Float
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from torch import Tensor

from bidnerf_core.geometry import SE3

Understand = Callable[[SE3], SE3]
"""Maps the given poses (n) to the true T_world_camera; NaN for an image left without a pose."""

AS_GIVEN = torch.eye(3, dtype=torch.float64)
Y_AND_Z_REVERSED = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
SWAP = "multiply each from the right by diag(1, -1, -1, 1)"


@dataclass(frozen=True)
class Reading:
    """One interpretation of given poses, in words and as a transformation."""

    clause: str  # completes "the poses would agree if ..."
    remedy: str  # what to do about it
    understand: Understand


def changed(
    T: SE3,
    axes: Float[Tensor, "3 3"] = AS_GIVEN,
    positions: Float[Tensor, "3 3"] = AS_GIVEN,
    mirror: Float[Tensor, "3 3"] = AS_GIVEN,
    inverted: bool = False,
) -> SE3:
    """Return poses with rotations ``mirror R axes`` and translations ``positions t``; first inverted if ``inverted``.

    The columns of ``axes`` are the true camera's axes in the given camera's frame.
    """
    T = T.inverse() if inverted else T
    return SE3(mirror @ T.rotation @ axes, T.translation @ positions.mT)


@cache
def readings(count: int) -> tuple[Reading, ...]:
    """Return the readings of ``count`` poses, common ones first: among those that fit equally well, the first is preferred."""
    return (
        *_of_axes(),
        *_of_parts(),
        *_of_quaternions(),
        *_of_worlds(),
        *_of_positions(),
        *_of_orders(count),
    )


def _of_axes() -> Iterator[Reading]:
    """Yield readings with other camera axes, starting with y and z reversed; then those as inverse matrices, too."""
    yield Reading(
        "their cameras' y and z axes are reversed (OpenCV's and COLMAP's axes where OpenGL's and Blender's are expected, or the"
        " other way round)",
        SWAP, partial(changed, axes=Y_AND_Z_REVERSED),
    )  # fmt: skip
    rotations = signed_permutations(1)  # as given first, then with y and z reversed
    names = [f"right, down and forward are {_named(axes)}" for axes in rotations]
    for axes, name in zip(rotations[2:], names[2:], strict=True):
        yield Reading(
            f"their cameras have other axes: {name}",
            "permute and reverse the first three columns of each accordingly",
            partial(changed, axes=axes),
        )
    for number, (axes, name) in enumerate(zip(rotations, names, strict=True)):
        yield Reading(
            f"they are inverses (world to camera){'' if number < 2 else f', of cameras whose {name}'}",
            f"invert each, and if they are then rejected again, {SWAP}",
            partial(changed, axes=axes, inverted=True),
        )


Part = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
PARTS: tuple[tuple[Part, str, str], ...] = (
    (lambda R, t: (R.mT, t), "their rotations are transposed, while their positions are right", "transpose the upper left 3x3 of each"),
    (lambda R, t: (R, -t), "their positions are negated", "multiply the first three numbers of the fourth column of each by -1"),
    (lambda R, t: (R, -R @ t), "their translations are those of inverses, while their rotations are not", "replace each translation t by -R t"),
    (lambda R, t: (R.mT, -t), "their rotations are transposed and their positions negated", "transpose the upper left 3x3 of each, and negate the fourth column"),
    (lambda R, t: (R.mT, R.mT @ t), "they are inverses whose translations lack the minus sign", "transpose each rotation R, and replace t by R^T t"),
    (lambda R, t: (R, -R.mT @ t), "their translations are -R times the positions", "replace each translation t by -R^T t"),
    (lambda R, t: (R, R @ t), "their translations are those of inverses without the minus sign, while their rotations are"
                " not", "replace each translation t by R t"),
    (lambda R, t: (R, R.mT @ t), "their translations are R times the positions", "replace each translation t by R^T t"),
    (lambda R, t: (R.mT, R @ t), "their rotations are transposed, and their translations rotated", "transpose each rotation R, and replace t by R t"),
    (lambda R, t: (R.mT, -R @ t), "their rotations are transposed, and their translations rotated and negated", "transpose each rotation R, and replace t by -R t"),
)  # fmt: skip
"""The true rotation and position (a column) as functions of the given ones, and what is wrong then."""


def _of_parts() -> Iterator[Reading]:
    def understand(T: SE3, part: Part) -> SE3:
        rotation, position = part(T.rotation, T.translation[..., None])
        return SE3(rotation, position[..., 0])

    for part, clause, remedy in PARTS:
        yield from _in_file_axes(clause, remedy, partial(understand, part=part))


def _of_quaternions() -> Iterator[Reading]:
    """Yield readings of quaternions with w taken from the wrong end, for poses and for their inverses."""

    def understand(T: SE3, order: list[int], of_inverse: bool, then_invert: bool) -> SE3:
        T = T.inverse() if of_inverse else T
        quaternion = rotation_matrix_to_quaternion(T.rotation.contiguous())  # w x y z
        T = SE3(quaternion_to_rotation_matrix(quaternion[..., order]), T.translation)
        return T.inverse() if of_inverse != then_invert else T

    orders = (([3, 0, 1, 2], "x y z w", "w x y z"), ([1, 2, 3, 0], "w x y z", "x y z w"))
    for (order, found, expected), of_inverse, then_invert in itertools.product(
        orders, (False, True), (False, True)
    ):
        also = ", and the poses are inverses (world to camera)" if then_invert else ""
        yield from _in_file_axes(
            f"their quaternions are in the order {found}, but {expected} is expected{also}",
            f"write the quaternions as {expected}{', and invert the poses' if then_invert else ''}",
            partial(understand, order=order, of_inverse=of_inverse, then_invert=then_invert),
        )


def _of_worlds() -> Iterator[Reading]:
    """Yield readings of left-handed worlds and cameras, as in Unity and Unreal: a mirror image of both."""
    for axes in signed_permutations(-1):
        signs = axes.diagonal()
        diagonal = bool(signs.all())
        if diagonal and bool((signs < 0).all()):
            continue  # negated positions
        mirror = axes if diagonal else torch.diag(axes.new_tensor([1.0, 1.0, -1.0]))
        factors = ", ".join(f"{value:g}" for value in [*mirror.diagonal().tolist(), 1])
        more = "" if diagonal else f"; right, down and forward of the cameras are then {_named(axes)}"
        yield Reading(
            "their axes are left-handed, as in Unity",
            f"multiply each from {'both sides' if diagonal else 'the left'} by diag({factors}){more}",
            partial(changed, axes=axes, positions=mirror, mirror=mirror),
        )


def _of_positions() -> Iterator[Reading]:
    """Yield readings in which positions have different axes from the rotations."""
    for D in (*signed_permutations(-1), *signed_permutations(1)):
        if bool(D.diagonal().all()):
            wrong = [name for name, value in zip("xyz", D.diagonal().tolist(), strict=True) if value < 0]
            if len(wrong) in (0, 3):
                continue  # as given, or negated
            clause = f"{' and '.join(wrong)} of their positions {'is' if len(wrong) == 1 else 'are'} reversed"
        else:
            order = [("-" if row.sum() < 0 else "") + "xyz"[int(row.abs().argmax())] for row in D]
            clause = f"x, y and z of their positions are the given ones' {', '.join(order)}"
        remedy = "correct the fourth column of each, not the rotations"
        yield Reading(clause, remedy, partial(changed, positions=D))
        yield Reading(
            f"{clause}, and their cameras' y and z axes are reversed", f"{remedy}, and {SWAP}",
            partial(changed, axes=Y_AND_Z_REVERSED, positions=D),
        )  # fmt: skip


def _of_orders(count: int) -> Iterator[Reading]:
    """Yield readings in which poses belong to other images."""

    def understand(T: SE3, order: Sequence[int]) -> SE3:
        index = torch.tensor([i if 0 <= i < count else -1 for i in order])
        unknown = torch.where(index >= 0, 0.0, torch.nan).to(T.translation)
        return SE3(T.rotation[index], T.translation[index] + unknown[:, None])

    shifts = {1: "the next image", -1: "the image before", 2: "the image after next", -2: "the image before the previous one"}  # fmt: skip
    orders = list[tuple[str, Sequence[int]]](
        (f"each is that of {words}", range(-by, count - by)) for by, words in shifts.items()
    )
    orders.append(("they are in the reverse order of the images", range(count)[::-1]))
    for first in (0, 1):
        texts = [str(i + first) for i in range(count)]
        by_text = sorted(range(count), key=texts.__getitem__)
        inverse = sorted(range(count), key=by_text.__getitem__)
        text, numeric = "in text order (1, 10, 11, 2)", "in numeric order"
        orders.append((f"they are {text}, while the images are {numeric}", inverse))
        orders.append((f"they are {numeric}, while the images are {text}", by_text))
    for clause, order in orders:
        yield from _in_file_axes(clause, "reassign the poses to the images", partial(understand, order=order))


def _in_file_axes(clause: str, remedy: str, understand: Understand) -> Iterator[Reading]:
    """Yield a reading of matrices as they are here, and as they were in a file that had the y and z axes reversed."""

    def whole(T: SE3, before: Tensor, after: Tensor) -> SE3:
        return changed(understand(changed(T, before)), after)

    # A reader has reversed y and z of correct poses as well, so this needs no remedy; a reversal on one side only does.
    for axes in ((AS_GIVEN, AS_GIVEN), (Y_AND_Z_REVERSED, Y_AND_Z_REVERSED)):
        yield Reading(clause, remedy, partial(whole, before=axes[0], after=axes[1]))
    for axes in ((AS_GIVEN, Y_AND_Z_REVERSED), (Y_AND_Z_REVERSED, AS_GIVEN)):
        also = ", and their cameras' y and z axes are reversed"
        yield Reading(clause + also, f"{remedy}, then {SWAP}", partial(whole, before=axes[0], after=axes[1]))


def signed_permutations(determinant: int) -> list[Float[Tensor, "3 3"]]:
    """Return the 24 signed permutation matrices with a determinant of 1 or -1, starting with the identity if included."""
    orders, signs = itertools.permutations(range(3)), list(itertools.product((1.0, -1.0), repeat=3))
    found = (AS_GIVEN[list(order)] * torch.tensor([s]).mT for order in orders for s in signs)
    return [A for A in found if round(float(torch.linalg.det(A))) == determinant]


def _named(axes: Float[Tensor, "3 3"]) -> str:
    """Describe where the true camera's axes point, in terms of the given camera's."""
    names = ("right", "down", "forward"), ("left", "up", "backward")
    words = [names[int(column.sum() < 0)][int(column.abs().argmax())] for column in axes.mT]
    return "the given ones' {}, {} and {}".format(*words)
