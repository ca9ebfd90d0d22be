"""A pytest plugin (``-p tests.golden.reads``): writes what golden tests read to ``$GSIM3D_GOLDEN_READS``, as JSON."""

import json
import os
from pathlib import Path

from tests.golden_files import READ


def pytest_sessionfinish():
    Path(os.environ["GSIM3D_GOLDEN_READS"]).write_text(json.dumps(sorted(READ)))
