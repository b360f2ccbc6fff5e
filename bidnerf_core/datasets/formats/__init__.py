"""The bundled readers, one module per format; each is registered by its name.

Unless a format has splits of its own, every eighth image with a pose (the first, the ninth ...) is held out as "test" and the
others are "train", see ``hold_out``.
"""
