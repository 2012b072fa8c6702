"""``python -m torchfra``."""

import sys

from torchfra.app.cli import main

sys.exit(main())
