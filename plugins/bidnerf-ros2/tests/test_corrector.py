"""A thread that localizes behind a fast loop: its correction, dropped frames, errors, and its end."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from bidnerf import SE3, Frame, InputError, Intrinsics, Localization, Outcome
from bidnerf_ros2.corrector import Corrector

CAMERA = Intrinsics(width=4, height=3, fx=4.0, fy=4.0, cx=2.0, cy=1.5)
FRAME = Frame("a", torch.zeros((3, 4, 3)), CAMERA)
SECONDS = 20.0  # after which a test fails instead of waiting for ever


def pose(*tangent: float) -> SE3:
    return SE3.exp(torch.tensor(tangent, dtype=torch.float64))


T_WORLD_CAMERA, T_ODOM_CAMERA = pose(0.1, 0.2, 0.3, 0.4, 0.5, 0.6), pose(3.0, -1.0, 2.0, 0.3, 0.0, -0.2)
FOUND = Localization(
    T_WORLD_CAMERA, Outcome.CONVERGED, "", 1, 0.1, 0.0, "auto", SE3.stack([T_WORLD_CAMERA]), torch.zeros(1)
)


class Stopped:
    """A localizer that waits before each answer until the test lets it go on."""

    def __init__(self, *answers: Localization | Exception) -> None:
        self.answers, self.starts = list(answers), list[SE3 | None]()
        self.began, self.go_on = threading.Semaphore(0), threading.Semaphore(0)

    def __call__(self, frame: Frame, start: SE3 | None = None) -> Localization:
        self.starts.append(start)
        self.began.release()
        assert self.go_on.acquire(timeout=SECONDS)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


@pytest.fixture
def corrector() -> Callable[..., Any]:
    def make(*answers: Localization | Exception) -> tuple[Stopped, Corrector]:
        localizer: Any = Stopped(*answers)
        return localizer, Corrector(localizer)

    return make


def until(condition: Callable[[], object]) -> None:
    """Wait until a condition holds."""
    waited = threading.Event()
    for _ in range(int(SECONDS / 0.005)):
        if condition():
            return
        waited.wait(0.005)
    raise AssertionError("waited in vain")


def test_an_accepted_answer_corrects_the_odometry_of_its_frame(corrector: Callable[..., Any]) -> None:
    localizer, mine = corrector(FOUND, replace(FOUND, outcome=Outcome.AMBIGUOUS, T_world_camera=pose(*[9.0] * 6)))
    assert mine.T_world_odom is None
    assert mine.correct(T_ODOM_CAMERA) is None
    assert mine.give(FRAME, T_ODOM_CAMERA)
    localizer.go_on.release()
    until(lambda: mine.T_world_odom is not None)
    torch.testing.assert_close(mine.correct(T_ODOM_CAMERA).matrix(), T_WORLD_CAMERA.matrix())
    moved = T_ODOM_CAMERA @ pose(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)
    torch.testing.assert_close(
        mine.correct(moved).matrix(), (T_WORLD_CAMERA @ pose(0.1, 0.0, 0.0, 0.0, 0.0, 0.0)).matrix()
    )
    assert mine.give(FRAME, moved)  # a rejected answer, which changes nothing
    localizer.go_on.release()
    until(lambda: mine.found is not FOUND)
    mine.close()
    torch.testing.assert_close(mine.correct(T_ODOM_CAMERA).matrix(), T_WORLD_CAMERA.matrix())
    assert localizer.starts[0] is None
    torch.testing.assert_close(localizer.starts[1].matrix(), mine.correct(moved).matrix())


def test_a_frame_is_dropped_while_another_waits(corrector: Callable[..., Any]) -> None:
    localizer, mine = corrector(FOUND, FOUND)
    assert mine.give(FRAME, pose(*[0.0] * 6))
    assert localizer.began.acquire(timeout=SECONDS)  # it is at work, so the next one waits
    assert mine.give(FRAME, pose(1.0, *[0.0] * 5))
    assert not mine.give(FRAME, pose(2.0, *[0.0] * 5))
    localizer.go_on.release(2)
    until(lambda: len(localizer.starts) == 2 and not localizer.answers)
    mine.close()
    T = mine.T_world_odom.inverse() @ T_WORLD_CAMERA
    assert T.translation.tolist() == pytest.approx([1.0, 0.0, 0.0])  # of the frame that waited


def test_an_error_reaches_the_caller_once_and_the_next_frame_is_localized(
    corrector: Callable[..., Any],
) -> None:
    localizer, mine = corrector(InputError("no light", where="a"), FOUND)
    assert mine.give(FRAME, T_ODOM_CAMERA)
    assert localizer.began.acquire(timeout=SECONDS)
    assert mine.give(FRAME, T_ODOM_CAMERA)
    localizer.go_on.release(2)
    until(lambda: mine.T_world_odom is not None)
    with pytest.raises(InputError, match="a: no light"):
        mine.give(FRAME, T_ODOM_CAMERA)
    mine.close()


def test_closing_waits_for_the_work_drops_what_waits_and_raises_an_error(
    corrector: Callable[..., Any],
) -> None:
    localizer, mine = corrector(RuntimeError("broken"), FOUND)
    mine.give(FRAME, T_ODOM_CAMERA)
    assert localizer.began.acquire(timeout=SECONDS)
    assert mine.give(FRAME, T_ODOM_CAMERA)
    threading.Timer(0.05, localizer.go_on.release).start()
    with pytest.raises(RuntimeError, match="broken"):
        mine.close()
    assert len(localizer.answers) == 1  # the frame that waited was not localized
    mine.close()  # again: nothing is left to say
    with pytest.raises(InputError, match="the corrector is closed"):
        mine.give(FRAME, T_ODOM_CAMERA)


def test_many_threads_may_give(corrector: Callable[..., Any]) -> None:
    localizer, mine = corrector(*[FOUND] * 1000)
    localizer.go_on.release(1000)
    taken = list[bool]()
    with mine:
        threads = [
            threading.Thread(target=lambda: taken.extend(mine.give(FRAME, T_ODOM_CAMERA) for _ in range(50)))
            for _ in range(8)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(SECONDS)
    assert len(taken) == 400
    assert sum(taken) - 2 <= len(localizer.starts) <= sum(taken)  # closing may drop those that have not begun
