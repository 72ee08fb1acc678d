"""Multi-resolution hash encoding and dense grids."""
