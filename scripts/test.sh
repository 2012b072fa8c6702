#!/usr/bin/env bash
# Lint, types and tests, in an environment of their own.  Other arguments go to pytest.
what=
for argument; do
  case $argument in
    -h | --help)
      echo "usage: bash scripts/test.sh [--quick | --all] [ARGUMENT ...]    arguments go to pytest"
      echo "What has to pass before a commit, in five minutes on two cores; --quick: a core, in half a minute; --all: every test."
      exit ;;
    --quick | --all)
      [ -z "$what" ] || { echo "test: expected one of --quick and --all, received both or one twice" >&2; exit 2; }
      what=$argument ;;
  esac
done
arguments=()
for argument; do [[ $argument = --quick || $argument = --all ]] || arguments+=("$argument"); done
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh" dev
ruff check .
ruff format --check .
types=
case $what in
  --quick)
    # Square roots and their gradients, and filters against what is written in numpy from their papers alone.
    arguments=(-m "not slow" tests/test_{tria,oracles,gpb_oracle,imm,states}.py "${arguments[@]}") ;;
  *)
    said=$(mktemp)
    mypy --strict > "$said" 2>&1 &  # beside the tests, as it has work for one core
    types=$!
    [ "$what" ] || arguments=(-m "not slow" "${arguments[@]}") ;;
esac
# One worker for each core, which takes over tests of another where it has none left, and one thread for each worker.
failed=0
OMP_NUM_THREADS=1 pytest -n auto --dist worksteal "${arguments[@]}" || failed=$?
if [ "$types" ]; then
  wait "$types" || failed=$?
  cat "$said"
  rm "$said"
fi
exit "$failed"
