"""SIMD registers, their loads and stores, and LLVM intrinsics as Numba types and functions."""
