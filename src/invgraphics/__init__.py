"""Compare and teach differentiable rendering: NeRF volume rendering versus splatting, on one ruler."""
