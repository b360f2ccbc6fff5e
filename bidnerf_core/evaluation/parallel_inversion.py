"""The 25 starts of Parallel Inversion, from the description of its published bulk experiment.

The paper is Lin et al. 2023, "Parallel Inversion of Neural Radiance Fields for Robust Pose Estimation".
The program seeds NumPy's legacy generator once and draws 5 frames of the test file *with* replacement, 5x5x3 Euler
angles uniform in +-15 degrees, and 5x5x3 translations uniform in +-0.25. The angles (phi, theta, psi) turn the camera about
its own centre and the *world's* axes, R' = Rz(phi) Ry(-theta) Rx(psi) R, and the centre moves along the world's axes. The
numbers depend on the number of frames in the split, since the choice of frames consumes random numbers. Ranges and seed
are options of the program that its repository sets for each experiment; 1234, 15 and 0.25 are assumed here. The
published scenes may be scaled; here lengths are those of the data.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry.se3 import SE3

SEED, CHOSEN_FRAMES, STARTS = 1234, 5, 5
TRIALS = CHOSEN_FRAMES * STARTS
ROTATION_DEG, TRANSLATION = 15.0, 0.25

Drawn = tuple[Int[np.ndarray, "5"], Float[np.ndarray, "5 5 3"], Float[np.ndarray, "5 5 3"]]


def draw_starts(frames: int) -> Drawn:
    """Return the published indices of frames, angles (degrees) and translations (units of the data), bit for bit."""
    generator = np.random.RandomState(SEED)
    chosen = generator.choice(frames, CHOSEN_FRAMES)
    angles = generator.uniform(-ROTATION_DEG, ROTATION_DEG, size=(CHOSEN_FRAMES, STARTS, 3))
    return chosen, angles, generator.uniform(-TRANSLATION, TRANSLATION, size=(CHOSEN_FRAMES, STARTS, 3))


def parallel_cases(frames: int, trials: int, seed: int) -> list[tuple[int, int]]:
    """Return the index of the frame and the seed of each trial; 1234 is the first of the 25."""
    if seed != SEED or trials > TRIALS:
        raise InputError(
            f"parallel: {trials} trials from seed {seed}, expected {TRIALS} at most from seed {SEED}: it is a fixed list"
        )
    chosen = draw_starts(frames)[0]
    return [(int(chosen[i // STARTS]), SEED + i) for i in range(trials)]


def parallel_start(T_true: SE3, seed: int, frames: int) -> SE3:
    """Return T_world_camera of the trial with ``seed`` (1234 to 1258) in a split of ``frames`` frames."""
    if not SEED <= seed < SEED + TRIALS:
        raise InputError(f"parallel: seed is {seed}, expected {SEED} to {SEED + TRIALS - 1}")
    _, angles, moves = draw_starts(frames)
    place = divmod(seed - SEED, STARTS)
    turn = euler(angles[place])
    true = T_true.to(dtype=torch.float64)
    return SE3(turn @ true.rotation, true.translation + torch.from_numpy(moves[place]))


def euler(angles_deg: Float[np.ndarray, "3"]) -> Float[Tensor, "3 3"]:
    """Return the rotation Rz(phi) Ry(-theta) Rx(psi)."""
    (c1, c2, c3), (s1, s2, s3) = np.cos(angles_deg / 180.0 * np.pi), np.sin(angles_deg / 180.0 * np.pi)
    about_z = np.array([[c1, -s1, 0], [s1, c1, 0], [0, 0, 1]])
    about_y = np.array([[c2, 0, -s2], [0, 1, 0], [s2, 0, c2]])
    about_x = np.array([[1, 0, 0], [0, c3, -s3], [0, s3, c3]])
    return torch.from_numpy(about_z @ about_y @ about_x)
