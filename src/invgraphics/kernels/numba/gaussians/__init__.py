"""Ray tracing of 3D Gaussians on the CPU: pairs of rays and Gaussians, and the exact line integrals with their gradients."""
