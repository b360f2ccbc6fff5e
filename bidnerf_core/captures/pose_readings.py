"""Readings of camera poses: what given matrices would mean under another convention, or after another common
mistake.

Each reading is a transformation of all poses of a capture. They are built from a few tables, so adding one
takes a row: camera axes, full or partial inverses, quaternion orders, left-handed worlds, axes of the
positions, and the order of the images.
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
Axes = tuple[tuple[int, int, int], ...]
"""A signed permutation matrix by rows."""

AS_GIVEN: Axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
Y_AND_Z_REVERSED: Axes = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
SWAP = "multiply each from the right by diag(1, -1, -1, 1)"


@dataclass(frozen=True)
class Reading:
    """One interpretation of given poses, in words and as a transformation."""

    clause: str  # completes "the poses would agree if ..."
    remedy: str  # what to do about it
    understand: Understand
    axes: Axes = AS_GIVEN  # rows of R_given_true: the true camera's axes in the given camera's
    inverted: bool = False  # whether the given matrices are T_camera_world


@cache
def readings(count: int) -> tuple[Reading, ...]:
    """Return the readings of ``count`` poses, common ones first: among those that fit equally well, the first
    is preferred.
    """
    families = (
        _of_axes, _of_inverses, _of_parts, _of_quaternions, _of_left_handed_worlds, _of_positions, lambda: _of_orders(count),
    )  # fmt: skip
    return tuple(itertools.chain.from_iterable(family() for family in families))


def _of_axes() -> Iterator[Reading]:
    """Yield readings with other camera axes, starting with y and z reversed."""
    yield Reading(
        "their cameras' y and z axes are reversed (OpenCV's and COLMAP's axes where OpenGL's and Blender's are expected, or the"
        " other way round)",
        SWAP, lambda T: with_axes(T, _matrix(Y_AND_Z_REVERSED)), Y_AND_Z_REVERSED,
    )  # fmt: skip
    for axes in signed_permutations(1):
        if axes not in (AS_GIVEN, Y_AND_Z_REVERSED):
            yield Reading(
                f"their cameras have other axes: right, down and forward are {_named(axes)}",
                "permute and reverse the first three columns of each accordingly",
                partial(with_axes, axes=_matrix(axes)), axes,
            )  # fmt: skip


def _of_inverses() -> Iterator[Reading]:
    """Yield readings as inverse matrices, with every choice of axes."""
    for axes in sorted(signed_permutations(1), key=lambda axes: axes not in (AS_GIVEN, Y_AND_Z_REVERSED)):
        also = f", of cameras whose right, down and forward are {_named(axes)}"
        yield Reading(
            f"they are inverses (world to camera){'' if axes in (AS_GIVEN, Y_AND_Z_REVERSED) else also}",
            f"invert each, and if they are then rejected again, {SWAP}",
            partial(_inverse_with_axes, axes=_matrix(axes)), axes, True,
        )  # fmt: skip


PARTS = (
    ("R^T", "", 1, "their rotations are transposed, while their positions are right", "transpose the upper left 3x3 of each"),
    ("R", "", -1, "their positions are negated", "multiply the first three numbers of the fourth column of each by -1"),
    ("R", "R", -1, "their translations are those of inverses, while their rotations are not", "replace each translation t by -R t"),
    ("R^T", "", -1, "their rotations are transposed and their positions negated", "transpose the upper left 3x3 of each, and negate the fourth column"),
    ("R^T", "R^T", 1, "they are inverses whose translations lack the minus sign", "transpose each rotation R, and replace t by R^T t"),
    ("R", "R^T", -1, "their translations are -R times the positions", "replace each translation t by -R^T t"),
    ("R", "R", 1, "their translations are those of inverses without the minus sign, while their rotations are"
                " not", "replace each translation t by R t"),
    ("R", "R^T", 1, "their translations are R times the positions", "replace each translation t by R^T t"),
    ("R^T", "R", 1, "their rotations are transposed, and their translations rotated", "transpose each rotation R, and replace t by R t"),
    ("R^T", "R", -1, "their rotations are transposed, and their translations rotated and negated", "transpose each rotation R, and replace t by -R t"),
)  # fmt: skip
"""Rotation and translation interpreted separately: which rotation is the true one, the factor that turns the
translation into the camera position, and its sign. ``R`` is the given rotation."""


def _of_parts() -> Iterator[Reading]:
    for rotation, factor, sign, clause, remedy in PARTS:

        def understand(T: SE3, rotation: str = rotation, factor: str = factor, sign: int = sign) -> SE3:
            ways = {"R": T.rotation, "R^T": T.rotation.mT, "": torch.eye(3, dtype=T.rotation.dtype)}
            return SE3(ways[rotation], sign * (ways[factor] @ T.translation[..., None])[..., 0])

        yield from _in_file_axes(clause, remedy, understand)


def _of_quaternions() -> Iterator[Reading]:
    """Yield readings of quaternions with w taken from the wrong end, for poses and for their inverses."""
    for order, found, expected in (
        ((3, 0, 1, 2), "x y z w", "w x y z"),
        ((1, 2, 3, 0), "w x y z", "x y z w"),
    ):
        for of_inverse, then_invert in itertools.product((False, True), repeat=2):

            def understand(
                T: SE3,
                order: tuple[int, ...] = order,
                of_inverse: bool = of_inverse,
                then: bool = then_invert,
            ) -> SE3:
                T = T.inverse() if of_inverse else T
                quaternion = rotation_matrix_to_quaternion(T.rotation.contiguous())  # w x y z
                T = SE3(quaternion_to_rotation_matrix(quaternion[..., list(order)]), T.translation)
                return T.inverse() if of_inverse != then else T

            also = ", and the poses are inverses (world to camera)" if then_invert else ""
            yield from _in_file_axes(
                f"their quaternions are in the order {found}, but {expected} is expected{also}",
                f"write the quaternions as {expected}{', and invert the poses' if then_invert else ''}", understand,
            )  # fmt: skip


def _of_left_handed_worlds() -> Iterator[Reading]:
    """Yield readings of left-handed worlds and cameras, as in Unity and Unreal: a mirror image of both."""
    for axes in signed_permutations(-1):
        A = _matrix(axes)
        diagonal = torch.equal(A, torch.diag(A.diagonal()))
        mirror = A if diagonal else torch.diag(A.new_tensor([1.0, 1.0, -1.0]))
        if diagonal and bool((A.diagonal() < 0).all()):
            continue  # negated positions
        signs = ", ".join(f"{value:g}" for value in [*mirror.diagonal().tolist(), 1])
        sides = f"from both sides by diag({signs})" if diagonal else f"from the left by diag({signs})"
        more = "" if diagonal else f"; right, down and forward of the cameras are then {_named(axes)}"
        yield Reading(
            "their axes are left-handed, as in Unity",
            f"multiply each {sides}{more}",
            partial(_mirrored, axes=A, mirror=mirror),
        )  # fmt: skip


def _of_positions() -> Iterator[Reading]:
    """Yield readings in which positions have different axes from the rotations."""
    for sign in (-1, 1):
        for axes in signed_permutations(sign):
            D = _matrix(axes)
            if bool((D.abs() == torch.eye(3, dtype=torch.float64)).all()):
                reversed_ = [
                    name for name, value in zip("xyz", D.diagonal().tolist(), strict=True) if value < 0
                ]
                if len(reversed_) in (0, 3):
                    continue  # as given, or negated
                clause = f"{' and '.join(reversed_)} of their positions {'is' if len(reversed_) == 1 else 'are'} reversed"
            else:
                order = ["xyz"[next(i for i, value in enumerate(row) if value)] for row in axes]
                order = [
                    f"{'-' if min(row) < 0 else ''}{name}" for row, name in zip(axes, order, strict=True)
                ]
                clause = f"x, y and z of their positions are the given ones' {', '.join(order)}"

            def understand(T: SE3, D: Tensor = D) -> SE3:
                return SE3(T.rotation, (D @ T.translation[..., None])[..., 0])

            remedy = "correct the fourth column of each, not the rotations"
            yield Reading(clause, remedy, understand)
            yield Reading(
                f"{clause}, and their cameras' y and z axes are reversed", f"{remedy}, and {SWAP}",
                partial(_positions_and_axes, of_positions=understand), Y_AND_Z_REVERSED,
            )  # fmt: skip


def _of_orders(count: int) -> Iterator[Reading]:
    """Yield readings in which poses belong to other images."""
    numbers = list(range(count))
    text, text_from_1 = (sorted(numbers, key=lambda i: str(i + first)) for first in (0, 1))
    orders: list[tuple[str, Sequence[int]]] = []
    for shift, words in ((1, "the next image"), (-1, "the image before"), (2, "the image after next"), (-2, "the image before the previous one")):  # fmt: skip
        orders.append(
            (f"each is that of {words}", [i - shift if 0 <= i - shift < count else -1 for i in numbers])
        )
    orders.append(("they are in the reverse order of the images", numbers[::-1]))
    for order in (text, text_from_1):
        orders.append(
            (
                "they are in text order (1, 10, 11, 2), while the images are in numeric order",
                _inverse(order),
            )
        )
        orders.append(("they are in numeric order, while the images are in text order (1, 10, 11, 2)", order))
    for clause, places in orders:

        def understand(T: SE3, order: Sequence[int] = places) -> SE3:
            index = torch.tensor(order)
            unknown = torch.where(index >= 0, 0.0, torch.nan).to(T.translation)
            return SE3(T.rotation[index], T.translation[index] + unknown[:, None])

        yield from _in_file_axes(clause, "reassign the poses to the images", understand)


def _in_file_axes(clause: str, remedy: str, understand: Understand) -> Iterator[Reading]:
    """Yield a reading of matrices as they are here, and as they were in a file that had the y and z axes
    reversed.
    """
    for before, after in ((False, False), (True, True), (False, True), (True, False)):

        def whole(T: SE3, before: bool = before, after: bool = after) -> SE3:
            F = _matrix(Y_AND_Z_REVERSED)
            T = understand(with_axes(T, F) if before else T)
            return with_axes(T, F) if after else T

        # A reader has reversed y and z of correct poses as well, so this needs no remedy; a reversal on one
        # side only does.
        more = before != after
        also = ", and their cameras' y and z axes are reversed" if more else ""
        yield Reading(clause + also, remedy + (f", then {SWAP}" if more else ""), whole)


def with_axes(T: SE3, axes: Float[Tensor, "3 3"]) -> SE3:
    """Return the poses of cameras whose axes are the columns of ``axes`` in the given camera frames."""
    return SE3(T.rotation @ axes.to(T.rotation), T.translation)


def _inverse_with_axes(T: SE3, axes: Float[Tensor, "3 3"]) -> SE3:
    return with_axes(T.inverse(), axes)


def _mirrored(T: SE3, axes: Float[Tensor, "3 3"], mirror: Float[Tensor, "3 3"]) -> SE3:
    return SE3(mirror @ T.rotation @ axes, T.translation @ mirror.mT)


def _positions_and_axes(T: SE3, of_positions: Understand) -> SE3:
    return with_axes(of_positions(T), _matrix(Y_AND_Z_REVERSED))


def signed_permutations(determinant: int) -> tuple[Axes, ...]:
    """Return the 24 signed permutation matrices with a determinant of 1 or -1, starting with the identity if
    included.
    """
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            rows = tuple(tuple(signs[i] if order[i] == j else 0 for j in range(3)) for i in range(3))
            if round(float(torch.linalg.det(_matrix(rows)))) == determinant:  # type: ignore[arg-type]
                found.append(rows)
    return tuple(found)  # type: ignore[arg-type]


def _matrix(axes: Axes) -> Float[Tensor, "3 3"]:
    return torch.tensor(axes, dtype=torch.float64)


def _inverse(order: Sequence[int]) -> list[int]:
    found = [0] * len(order)
    for place, number in enumerate(order):
        found[number] = place
    return found


def _named(axes: Axes) -> str:
    """Describe where the true camera's axes point, in terms of the given camera's."""
    names = ("right", "down", "forward"), ("left", "up", "backward")
    words = []
    for column in zip(*axes, strict=True):
        number = next(i for i, value in enumerate(column) if value)
        words.append(names[column[number] < 0][number])
    return "the given ones' {}, {} and {}".format(*words)
