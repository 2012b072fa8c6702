#!/usr/bin/env bash
# The documentation as pages in out/docs, with every warning an error and nothing from the network but what is installed.
case ${1:-} in
  -h | --help) echo "usage: bash scripts/docs.sh [ARGUMENT ...]    arguments go to sphinx-build"; exit ;;
esac
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh" docs
export OMP_NUM_THREADS=1 MPLBACKEND=agg
sphinx-build --fail-on-warning --keep-going --quiet --jobs auto -b html scripts/docs out/docs "$@"
echo "out/docs/index.html"
