"""The readers of the core: COLMAP, ``transforms.json``, TUM, and photos and videos; those of other formats are in ``bidnerf.formats``.

Unless a format has splits of its own, every eighth image with a pose (the first, the ninth ...) is held out as "test" and the
others are "train", see ``hold_out``.
"""
