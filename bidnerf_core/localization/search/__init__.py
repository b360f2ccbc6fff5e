"""Search: proposing poses and thinning them out."""
