"""``python -m warpir.report``."""

import sys

from warpir.report.command import main

sys.exit(main())
