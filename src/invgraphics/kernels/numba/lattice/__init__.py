"""Interpolation on voxel grids, planes and lines, and products of them."""
