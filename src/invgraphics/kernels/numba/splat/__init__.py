"""Projection, binning and rasterisation of Gaussians."""
