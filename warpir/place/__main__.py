"""``python -m warpir.place``."""

import sys

from warpir.place.command import main

sys.exit(main())
