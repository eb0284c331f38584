"""``python -m warpir.report``."""

import sys

from warpir.report.page import main

sys.exit(main())
