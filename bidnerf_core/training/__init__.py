"""Shared parts of training recipes: batches of rays, the loss, and the loop with its schedule, checkpoints and resumption."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
