"""The surface of a map: oriented discs (surfels) and an index of them, baked from a field's rendered depth or from measured depth."""
