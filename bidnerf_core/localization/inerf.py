"""Where an environment that was installed before the last change of entry points looks for a method."""

from bidnerf_core.localization.first_order import INERF as INERF
