"""Fused marching and rendering of Instant-NGP fields: a hash grid with small MLPs."""
