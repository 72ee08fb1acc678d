"""Registers of 16 numbers as a Numba type."""
