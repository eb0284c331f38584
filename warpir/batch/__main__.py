"""``python -m warpir.batch``."""

import sys

from warpir.batch.command import main

sys.exit(main())
