"""The 25 starts of Parallel Inversion (Lin et al. 2023, "Parallel Inversion of Neural Radiance Fields for Robust Pose
Estimation"), from the description of its published bulk experiment.

numpy's legacy generator is seeded once; then come 5 frames of the test file *with* replacement, 5x5x3 Euler angles
uniform in +-15 degrees, 5x5x3 translations uniform in +-0.25. Angles (phi, theta, psi) turn the camera about its own
centre and the *world's* axes: R' = Rz(phi) Ry(-theta) Rx(psi) R, and the centre moves along the world's axes. The
numbers are those of a split with the same number of frames: how many the generator uses up for the choice of frames
depends on it. Their ranges and seed are options of their program, which its repository sets for each experiment: 1234,
15 and 0.25 are taken as given here. Their prepared scenes may be scaled; here lengths are those of the data.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.se3 import SE3

SEED, FRAMES, STARTS = 1234, 5, 5
TRIALS = FRAMES * STARTS
ROTATION_DEG, TRANSLATION = 15.0, 0.25

Draw = tuple[Int[np.ndarray, "5"], Float[np.ndarray, "5 5 3"], Float[np.ndarray, "5 5 3"]]


def draw(frames: int) -> Draw:
    """Places of frames, degrees, and lengths in the data's units, bit for bit."""
    generator = np.random.RandomState(SEED)
    chosen = generator.choice(frames, FRAMES)
    angles = generator.uniform(-ROTATION_DEG, ROTATION_DEG, size=(FRAMES, STARTS, 3))
    return chosen, angles, generator.uniform(-TRANSLATION, TRANSLATION, size=(FRAMES, STARTS, 3))


def plan(frames: int, trials: int, seed: int) -> list[tuple[int, int]]:
    """Place of the frame and seed of each trial: 1234 is the first of the 25."""
    if seed != SEED or trials > TRIALS:
        raise InputError(
            f"parallel: {trials} trials from seed {seed}, expected {TRIALS} at most from seed {SEED}: it is a fixed list"
        )
    chosen = draw(frames)[0]
    return [(int(chosen[i // STARTS]), SEED + i) for i in range(trials)]


def start(T_true: SE3, seed: int, frames: int) -> SE3:
    """T_world_camera of the trial with that seed (1234 to 1258) in a split of so many frames."""
    if not SEED <= seed < SEED + TRIALS:
        raise InputError(f"parallel: seed is {seed}, expected {SEED} to {SEED + TRIALS - 1}")
    _, angles, moves = draw(frames)
    place = divmod(seed - SEED, STARTS)
    turn = euler(angles[place])
    true = T_true.to(dtype=torch.float64)
    return SE3(turn @ true.rotation, true.translation + torch.from_numpy(moves[place]))


def euler(angles_deg: Float[np.ndarray, "3"]) -> Float[Tensor, "3 3"]:
    """Rz(phi) Ry(-theta) Rx(psi)."""
    (c1, c2, c3), (s1, s2, s3) = np.cos(angles_deg / 180.0 * np.pi), np.sin(angles_deg / 180.0 * np.pi)
    about_z = np.array([[c1, -s1, 0], [s1, c1, 0], [0, 0, 1]])
    about_y = np.array([[c2, 0, -s2], [0, 1, 0], [s2, 0, c2]])
    about_x = np.array([[1, 0, 0], [0, c3, -s3], [0, s3, c3]])
    return torch.from_numpy(about_z @ about_y @ about_x)
