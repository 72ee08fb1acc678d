"""Fused marching and rendering of fields over lattices, with the queue of rays and the networks of `ngp`."""
