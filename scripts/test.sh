#!/usr/bin/env bash
# Lint, types and tests, in an environment of their own.  Arguments go to pytest.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh" dev
ruff check .
ruff format --check .
mypy --strict
pytest "$@"
