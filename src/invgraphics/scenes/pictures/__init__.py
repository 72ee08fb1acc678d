"""Photographs: reading, lens distortion, size, and what of them counts."""
