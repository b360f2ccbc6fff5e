"""Cost terms: how well poses explain the measurements."""
