"""``python -m warpir.train``."""

import sys

from warpir.train.command import main

sys.exit(main())
