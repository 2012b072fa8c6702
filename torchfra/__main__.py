"""``python -m torchfra``."""

import sys

from torchfra.cli import main

sys.exit(main())
