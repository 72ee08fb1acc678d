"""Multi-resolution hash encoding."""
