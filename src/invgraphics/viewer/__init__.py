"""A window into fitted runs, in a browser: any renderer's picture at the browser's camera (``invgraphics view``)."""
