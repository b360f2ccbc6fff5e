"""Cost terms: how well poses explain what was measured."""
