"""Gaussian splatting: project, intersect tiles, rasterise to pixels, and their backward passes."""
