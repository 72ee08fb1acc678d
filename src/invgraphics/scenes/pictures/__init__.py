"""Photographs: reading, lens distortion, size, and masks."""
