"""Conformance suites: whether a field or a renderer keeps its contract. `invgraphics.testing` offers them to plug-ins."""

from invgraphics.conformance.fields import check_field as check_field
from invgraphics.conformance.fields import perturb as perturb
from invgraphics.conformance.renderers import check_renderer as check_renderer
