#!/usr/bin/env bash
# Lint, types and tests, in an environment of their own.  Arguments go to pytest.
for argument; do
  case $argument in
    -h | --help)
      echo "usage: bash scripts/test.sh [ARGUMENT ...]    arguments go to pytest"
      echo "All tests take a quarter of an hour on two cores; -m 'not slow' leaves out those of more than a second: five minutes."
      exit ;;
  esac
done
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh" dev
ruff check .
ruff format --check .
mypy --strict
# One worker for each core, which takes over tests of another where it has none left, and one thread for each worker.
OMP_NUM_THREADS=1 pytest -n auto --dist worksteal "$@"
