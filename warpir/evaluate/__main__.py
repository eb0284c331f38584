"""``python -m warpir.evaluate``."""

import sys

from warpir.evaluate.command import main

sys.exit(main())
