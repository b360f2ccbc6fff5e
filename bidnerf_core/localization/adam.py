"""The paper's localizer: first-order descent on rendered colour and depth (BID-NeRF, Alg. 1)."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Generator, Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.field import widened
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.pixels import draw, measured_middle, uniform
from bidnerf_core.rendering import render
from bidnerf_core.residuals import objective
from bidnerf_core.se3 import SE3

WINDOW = 20
"""Steps over which the noisy loss is averaged before it is trusted."""


@dataclass(frozen=True)
class BidConfig:
    """Settings of method ``bid``."""

    rays: int = 2048  # in all, shared out equally among the views
    max_steps: int = 200
    learning_rate: float = (
        0.04  # metres that a step moves the camera, at first; radians about a pivot within 1 m
    )
    decay: float = 0.4  # factor on the learning rate ...
    decay_steps: int = 80  # ... after so many steps
    depth_weight: float = 1.0  # lambda_d
    huber_delta: float = 0.1  # of colour differences, and of metres
    level: int | None = 0  # of the field: 0 is the coarsest; none is the field itself, in full detail
    pivot: Literal["scene", "camera"] = "scene"  # what the update turns about; the paper's is the camera
    wide: float = 1.0  # sampled interval over [near, far]; the paper's "wide" is 2
    stop_loss: float = 0.0  # stop once the mean loss of 20 steps is below it (epsilon of Alg. 1); 0: never
    converged_loss: float = 0.02  # mean loss of the last 20 steps below which the answer is called converged

    def __post_init__(self) -> None:
        for name in ("rays", "max_steps", "decay_steps"):
            self._require(name, 1 <= getattr(self, name) <= 10**7, "1 to 10 million")
        for name, most in {"learning_rate": 1e3, "decay": 1.0, "huber_delta": 1e6, "wide": 100.0}.items():
            self._require(name, 0 < getattr(self, name) <= most, f"a positive number, at most {most:g}")
        for name in ("depth_weight", "stop_loss", "converged_loss"):
            value = getattr(self, name)
            self._require(name, math.isfinite(value) and value >= 0, "a number, 0 or more")

    def _require(self, name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise InputError(f"{name} is {getattr(self, name)}, expected {expected}")


def bid(problem: Problem, config: BidConfig, seed: int = 0) -> Localization:
    """Descend from ``problem.start``; pixels are drawn anew at each step, from ``seed``.

    Alg. 1 of the paper, with its loop test the right way round. Each step writes the pose as T exp(delta) about the
    current T, takes the gradient by delta at 0, and moves by what Adam makes of it.
    """
    began = time.perf_counter()
    generator = torch.Generator().manual_seed(seed)
    pivot = _pivot(problem, config)
    rho, phi = (torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    # About a far pivot a turn moves the camera by that much more: steps of both kinds are to move it equally far.
    rates = (config.learning_rate, config.learning_rate / max(1.0, float(pivot.translation.norm())))
    groups = [{"params": [part], "lr": rate} for part, rate in zip((rho, phi), rates, strict=True)]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.999))
    T, poses, losses = problem.start, [problem.start], []
    reason = f"reached {config.max_steps} steps"
    for step in range(config.max_steps):
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * config.decay ** (step / config.decay_steps)
        loss = _loss(problem, _moved(T, pivot, torch.cat([rho, phi])), config, generator)
        if not math.isfinite(float(loss.detach())):
            reason = f"the loss was {float(loss.detach())} at step {step + 1}"
            break
        losses.append(float(loss.detach()))
        if loss.requires_grad:  # it does not where no ray meets anything
            rho.grad, phi.grad = torch.autograd.grad(loss, (rho, phi))
            optimizer.step()
        moved = _moved(T, pivot, torch.cat([rho, phi]).detach())
        if not bool(moved.matrix().isfinite().all()):
            reason = f"the step was not finite at step {step + 1}"
            break
        T = moved.normalized()
        poses.append(T)
        with torch.no_grad():
            rho.zero_()
            phi.zero_()
        if step + 1 >= WINDOW and _recent(losses) < config.stop_loss:
            reason = f"mean loss of {WINDOW} steps fell below {config.stop_loss:g}"
            break
    return Localization(
        T_world_camera=T,
        converged=_recent(losses) < config.converged_loss,
        reason=reason,
        steps=len(poses) - 1,
        seconds=time.perf_counter() - began,
        loss=_recent(losses),
        method="bid",
        poses=SE3.stack(poses),
        losses=torch.tensor(losses, dtype=torch.float64),
    )


def _pivot(problem: Problem, config: BidConfig) -> SE3:
    """T_camera_pivot, a translation: the frame in which updates are written.

    For a camera some metres away, a turn and a sideways motion look almost alike: in its own frame the objective is a
    long narrow valley, along which first-order steps crawl. About the middle of what the camera sees, the two part.
    """
    if config.pivot == "camera":
        return SE3.identity()
    point = measured_middle(problem.views)
    if point is None:
        corners = torch.tensor([problem.bounds.lower, problem.bounds.upper], dtype=torch.float64)
        point = problem.start.inverse().apply(corners.mean(0))
    return SE3(torch.eye(3, dtype=torch.float64), point)


def _moved(T: SE3, pivot: SE3, delta: Tensor) -> SE3:
    return (T @ pivot).retract(delta) @ pivot.inverse()


def _loss(problem: Problem, T_world_last: SE3, config: BidConfig, generator: Generator) -> Tensor:
    """Eq. 6 on freshly drawn pixels."""
    pixels = draw(problem.views, config.rays, uniform, generator)
    rays = pixels.rays(T_world_last, problem.bounds)
    if config.wide != 1:
        rays = widened(rays, config.wide)
    rendering = render(problem.level(config.level), rays, problem.bounds.background)
    return objective(rendering, pixels, config.huber_delta, config.depth_weight)


def _recent(losses: list[float]) -> float:
    last = losses[-WINDOW:]
    return sum(last) / len(last) if last else float("nan")
