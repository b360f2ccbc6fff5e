"""Where an environment that was installed before the last change of entry points looks for a method."""

from bidnerf_core.localization.second_order import BID_LM as BID_LM
