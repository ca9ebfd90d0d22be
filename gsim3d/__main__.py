"""``python -m gsim3d``: the same as the ``gsim3d`` command."""

import sys

from gsim3d.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
