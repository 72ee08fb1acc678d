"""Hooks and penalties of neural point clouds."""
