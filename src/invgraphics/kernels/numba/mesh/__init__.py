"""Triangle meshes: z-buffer rasterisation, and interpolation of vertex features with its transpose."""
