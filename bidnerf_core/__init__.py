"""bidnerf: estimate the 6-DoF pose of RGB-D images in a radiance field of any kind."""

from __future__ import annotations

import os

from lazy_loader import attach_stub

# Waiting OpenMP threads should sleep, not spin: on cores shared with other work, spinning made training more than ten
# times slower. The variable must be set before torch is loaded; a value set by the user is kept.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Modules are imported on first use (PEP 562): importing torch takes seconds, and ``bidnerf --help`` does not need it.
__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
