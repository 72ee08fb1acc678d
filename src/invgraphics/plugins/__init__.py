"""Registries: literal dictionaries of ``"module:object"``, extended by entry points.

Nothing heavy is imported to *list* what there is; an object is imported when it is used.
A third-party package joins by declaring an entry point in the group ``invgraphics.<registry>``,
for instance ``[project.entry-points."invgraphics.fields"] mine = "my_package:MyFieldConfig"``.
A built-in part keeps its name: an entry point of the same name is left out, with a warning.
Scripts and notebooks `register` parts in their own process, as modules that the environment variable `MODULES` names do.
"""

from invgraphics.plugins.faults import raised_in as raised_in
from invgraphics.plugins.faults import unexpected as unexpected
from invgraphics.plugins.lookup import load as load
from invgraphics.plugins.lookup import load_all as load_all
from invgraphics.plugins.lookup import name_of as name_of
from invgraphics.plugins.lookup import names as names
from invgraphics.plugins.lookup import origin as origin
from invgraphics.plugins.registered import ANONYMOUS as ANONYMOUS
from invgraphics.plugins.registered import MODULES as MODULES
from invgraphics.plugins.registered import check_importable as check_importable
from invgraphics.plugins.registered import environment as environment
from invgraphics.plugins.registered import register as register
from invgraphics.plugins.registries import REGISTRIES as REGISTRIES
from invgraphics.plugins.registries import leave_out as leave_out
from invgraphics.plugins.sources import installed as installed
from invgraphics.plugins.sources import plugin_sources as plugin_sources
from invgraphics.plugins.sources import used_plugins as used_plugins
