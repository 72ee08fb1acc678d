"""Good inputs are made by the helpers of the loaders' and the formats' tests."""

import sys
from pathlib import Path

for folder in ("scenes", "formats"):
    sys.path.append(str(Path(__file__).parents[1] / folder))
