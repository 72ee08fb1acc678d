"""Photographs and their cameras are made by the helpers of the loaders' tests."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "scenes"))
