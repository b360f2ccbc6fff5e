"""Where an environment that was installed before the last change of entry points looks for ``sift``."""

from bidnerf_core.mapping.landmarks.features import SIFT as SIFT
