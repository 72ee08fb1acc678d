"""Functions of ``import invgraphics as ig``: load scenes and methods, fit, evaluate, compare, run studies."""

from invgraphics.api.comparing import compare as compare
from invgraphics.api.fitting import evaluate as evaluate
from invgraphics.api.fitting import fit as fit
from invgraphics.api.loading import load_method as load_method
from invgraphics.api.loading import load_run as load_run
from invgraphics.api.loading import load_scene as load_scene
from invgraphics.api.loading import save_scene as save_scene
from invgraphics.api.studying import ablate as ablate
from invgraphics.api.studying import load_study as load_study
