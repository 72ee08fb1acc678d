"""Occupancy-grid ray marching and volume-rendering compositing."""
