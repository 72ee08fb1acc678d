"""Fused ray marching of a hash grid with small networks."""
