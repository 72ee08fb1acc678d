"""Good inputs are made by the helpers of the loaders', the formats' and the reports' tests."""

import sys
from pathlib import Path

for folder in ("scenes", "formats", "report", "."):
    sys.path.append(str(Path(__file__).parents[1] / folder))
