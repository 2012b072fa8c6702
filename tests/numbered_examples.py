"""The examples of the documentation, as modules."""

import importlib.util
import sys
from pathlib import Path

FOLDER = Path(__file__).parent.parent / "scripts" / "examples"
EXAMPLES = {path.stem: path for path in sorted(FOLDER.glob("*.py"))}


def load(name):
    """An example as a module; its name begins with a digit, so that ``import`` cannot."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", EXAMPLES[name])
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
