"""Neural point clouds."""
