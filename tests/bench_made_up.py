"""Made-up measurements for the benchmark's tests."""

from invgraphics.bench.results import Measurement
from invgraphics.bench.timing import Timing


def measured(operation, implementation, direction, sizes, seconds, **more) -> Measurement:
    """A measurement whose quartiles are a tenth off its median."""
    timing = Timing(seconds, 0.9 * seconds, 1.1 * seconds, 5)
    return Measurement(operation, implementation, direction, sizes, more.pop("threads", 2), timing, **more)
