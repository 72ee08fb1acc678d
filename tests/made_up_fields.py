"""Fields of a given density, for tests of what samples them."""

from collections.abc import Callable

import torch
from torch import Tensor

from invgraphics.core import Field, FieldValues, Quantity, Samples


class OfDensity(Field):
    """A white field whose density is any function of samples; ``asked`` holds how many samples each query had."""

    provides = Quantity.DENSITY | Quantity.RADIANCE

    def __init__(self, density: Callable[[Samples], Tensor]) -> None:
        super().__init__()
        self.density, self.asked = density, []

    def query(self, samples: Samples, want: Quantity) -> FieldValues:
        self.asked.append(len(samples))
        return FieldValues(density=self.density(samples), radiance=torch.ones(len(samples), 3))


NOTHING = OfDensity(lambda samples: torch.zeros(len(samples)))
"""Empty space."""
