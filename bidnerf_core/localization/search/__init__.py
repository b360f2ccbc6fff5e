"""Search: propose poses, and discard all but the best."""
