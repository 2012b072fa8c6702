"""``python -m torchfra``."""

import sys

from torchfra.cli.main import main

sys.exit(main())
