"""Interactive viewer of fitted runs in a browser, through viser (``invgraphics view``)."""
