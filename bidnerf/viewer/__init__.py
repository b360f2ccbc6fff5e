"""The page that shows a map and localizations in it, either saved as a file that needs no server or served live."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
