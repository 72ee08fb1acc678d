"""``python -m invgraphics``: the command line."""

from invgraphics.cli.main import main

if __name__ == "__main__":
    main()
