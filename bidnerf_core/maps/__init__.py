"""Maps: their storage, training and baking."""
