"""Occupancy-grid marching and compositing."""
