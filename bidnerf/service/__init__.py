"""The HTTP service: photos in, poses out, from maps shared by several worker processes.

The listening process decodes nothing and does not import torch. It hands each request to a worker, a fork of the one
process that loaded the maps, so that a photo can crash only the worker that reads it, and each map is held in memory
only once.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
