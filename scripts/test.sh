#!/usr/bin/env bash
# Lint, types and tests, in an environment of their own.  Other arguments go to pytest.
what=
for argument; do
  case $argument in
    -h | --help)
      echo "usage: bash scripts/test.sh [--quick | --all] [ARGUMENT ...]    arguments go to pytest"
      echo "What has to pass before a commit, in ten minutes on two cores; --quick: a core, in half a minute; --all: every test."
      exit ;;
    --quick | --all)
      [ -z "$what" ] || { echo "test: expected one of --quick and --all, received both or one twice" >&2; exit 2; }
      what=$argument ;;
  esac
done
arguments=()
for argument; do [[ $argument = --quick || $argument = --all ]] || arguments+=("$argument"); done
types() { mypy --strict && mypy --config-file scripts/mypy.ini scripts; }  # scripts: that they call what there is
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh" dev
ruff check .
ruff format --check .
case $what in
  --quick)
    # Square roots and their gradients, and filters against what is written in numpy from their papers alone.
    arguments=(-m "not slow" tests/{linalg/test_tria,filters/test_oracles,filters/test_gpb_oracle,filters/test_imm,motion/test_states}.py "${arguments[@]}") ;;
  --all) types ;;
  *)
    types
    arguments=(-m "not slow" "${arguments[@]}") ;;
esac
# One worker for each core, which takes over tests of another where it has none left, and one thread for each worker.
OMP_NUM_THREADS=1 pytest -n auto --dist worksteal "${arguments[@]}"
