"""``python -m zoo``: the command line."""

import sys

from zoo.faces.cli import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
