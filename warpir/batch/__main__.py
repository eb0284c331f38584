"""``python -m warpir.batch``."""

import sys

from warpir.batch.command import main

if __name__ == "__main__":  # workers import this module under another name
    sys.exit(main())
