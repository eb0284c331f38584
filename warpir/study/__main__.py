"""``python -m warpir.study``."""

import sys

from warpir.study.command import main

sys.exit(main())
