"""Sequences for benchmarks of tracking: in other orders, at lower rates, and with faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
import torch.nn.functional as F

from bidnerf_core import Frame
from bidnerf_core.datasets import TimedFrame

SHORT = 160
"""The number of frames in all runs except those "in order"."""
FIRST = 40
"""The number of the frame at which faults begin."""

Frames = list[TimedFrame]


@dataclass(frozen=True)
class Run:
    """A sequence as shown to a tracker, and the frames in which its scene is not visible."""

    frames: Frames
    blind: range = range(0)
    returns: int | None = None  # the frame in which the scene is visible again, or another part of it


def whole(frames: Frames) -> Run:
    return Run(frames)


def thinned(every: int) -> Callable[[Frames], Run]:
    return lambda frames: Run(frames[::every])


def backwards(frames: Frames) -> Run:
    return Run(frames[::-1])


def covered(frames: Frames) -> Run:
    """Cover the camera for 15 frames, which then show dark noise."""
    dark = partial(covered_frame, generator=torch.Generator().manual_seed(0))
    return changed(frames, range(FIRST, FIRST + 15), dark)


def covered_frame(frame: Frame, generator: torch.Generator) -> Frame:
    """Return the frame as taken with the lens covered: dark noise, and no depth."""
    noise = 0.02 + 0.01 * torch.rand(frame.rgb.shape, generator=generator)
    return replace(frame, rgb=noise, depth=None if frame.depth is None else torch.zeros_like(frame.depth))


def plain_wall(frames: Frames) -> Run:
    """Show a wall of one colour, a metre away, with noise, for 30 frames."""
    generator = torch.Generator().manual_seed(0)

    def wall(frame: Frame) -> Frame:
        rgb = (0.6 + 0.02 * torch.randn(frame.rgb.shape, generator=generator)).clamp(0, 1)
        return replace(
            frame, rgb=rgb, depth=None if frame.depth is None else torch.full_like(frame.depth, 1.0)
        )

    return changed(frames, range(FIRST, FIRST + 30), wall)


def half_covered(frames: Frames) -> Run:
    """Move a textured object with depth over the left half of the image for 30 frames; the scene stays visible."""
    shifts = iter(range(0, 10**6, 3))

    def half(frame: Frame) -> Frame:
        height, width = frame.rgb.shape[:2]
        pattern = torch.rand((1, 3, 60, 80), generator=torch.Generator().manual_seed(0))
        texture = F.interpolate(pattern, size=(height, width), mode="bicubic")[0].permute(1, 2, 0).clamp(0, 1)
        rgb, shift = frame.rgb.clone(), next(shifts)
        rgb[:, : width // 2] = texture.roll((shift, 2 * shift), (0, 1))[:, : width // 2]
        depth = None if frame.depth is None else frame.depth.clone()
        if depth is not None:
            depth[:, : width // 2] = 0.6 + 0.002 * shift
        return replace(frame, rgb=rgb, depth=depth)

    return Run(changed(frames, range(FIRST, FIRST + 30), half).frames)


def carried(frames: Frames) -> Run:
    """Leave out up to 100 frames, and close the gap in the time stamps."""
    there = min(FIRST + 100, len(frames) - 20)
    before, after = frames[:FIRST], frames[there:]
    if before[-1].time is None or after[0].time is None or frames[FIRST].time is None:
        return Run(before + after, returns=FIRST)
    late = after[0].time - frames[FIRST].time  # type: ignore[operator]
    return Run(before + [replace(f, time=f.time - late) for f in after], returns=FIRST)  # type: ignore[operator]


def depth_stops(frames: Frames) -> Run:
    """Remove the depth of the second half, and the frames there that have nothing else."""
    half = len(frames) // 2
    bare = [replace(f, frame=replace(f.frame, depth=None)) for f in frames[half:] if f.frame.has_colour]
    return Run(frames[:half] + bare)


def exposure_ramp(frames: Frames) -> Run:
    """Change the exposure evenly from two stops under to two stops over, in linear light."""
    count = len(frames)

    def exposed(number: int, frame: Frame) -> Frame:
        linear = frame.rgb**2.2 * 2 ** (4 * number / count - 2)
        return replace(frame, rgb=linear.clamp(0, 1) ** (1 / 2.2))

    return Run([replace(f, frame=exposed(i, f.frame)) for i, f in enumerate(frames)])


def doubled(frames: Frames) -> Run:
    return Run([frame for frame in frames for _ in range(2)])


def out_of_order(frames: Frames) -> Run:
    """Exchange every seventh frame with the next."""
    mixed = list(frames)
    for place in range(5, len(mixed) - 1, 7):
        mixed[place], mixed[place + 1] = mixed[place + 1], mixed[place]
    return Run(mixed)


def without_times(frames: Frames) -> Run:
    return Run([replace(frame, time=None) for frame in frames])


def noisy_depth(frames: Frames) -> Run:
    """Add noise of 2 % to the measured depth."""
    generator = torch.Generator().manual_seed(0)

    def noisy(frame: Frame) -> Frame:
        if frame.depth is None:
            return frame
        noise = 1 + 0.02 * torch.randn(frame.depth.shape, generator=generator)
        return replace(frame, depth=frame.depth * noise)

    return Run(changed(frames, range(len(frames)), noisy).frames)


def without_depth_frames(run: Run) -> Run:
    """Return the run with only colours."""
    kept = [number for number, timed in enumerate(run.frames) if timed.frame.has_colour]
    blind = [place for place, number in enumerate(kept) if number in run.blind]
    returns = None if run.returns is None else sum(number < run.returns for number in kept)
    part = range(blind[0], blind[-1] + 1) if blind else range(0)
    return Run([run.frames[number] for number in kept], part, returns)


def changed(frames: Frames, part: range, change: Callable[[Frame], Frame]) -> Run:
    """Change the frames of a part, in which nothing of the scene is visible then."""
    shown = [replace(f, frame=change(f.frame)) if i in part else f for i, f in enumerate(frames)]
    return Run(shown, part, part.stop)


ORDERS: dict[str, Callable[[Frames], Run]] = {
    "in order": whole, "every 2nd": thinned(2), "every 4th": thinned(4), "backwards": backwards,
}  # fmt: skip
FAULTS: dict[str, Callable[[Frames], Run]] = {
    "covered for 15 frames": covered, "carried 100 frames on": carried, "plain wall for 30 frames": plain_wall,
    "half the image covered": half_covered, "depth stops": depth_stops, "exposure ramp": exposure_ramp,
    "frames doubled": doubled, "frames out of order": out_of_order, "no time stamps": without_times,
}  # fmt: skip
