"""The built-in scenes: procedural models that Mitsuba 3 renders into ground truth."""

from invgraphics.scenes.mitsuba.maker import make as make
from invgraphics.scenes.mitsuba.spec import names as names
