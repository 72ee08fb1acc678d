"""Fields over a class of objects: networks whose layers depend on a code."""
