"""From photographs to a scene: structure from motion with pycolmap, in a process of its own, and a report on its quality."""

from invgraphics.scenes.photos.job import PhotoJob as PhotoJob
from invgraphics.scenes.photos.maker import reconstruct as reconstruct
