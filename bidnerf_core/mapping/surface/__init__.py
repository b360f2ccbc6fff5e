"""The surface of a map: oriented discs (surfels) and their index, baked from rendered or measured depth."""
