#!/usr/bin/env bash
# The main job on real recorded tracks: calibration and glider flights, seen by two bearings stations with outliers.
for argument; do
  case $argument in
    -h | --help) echo "usage: bash scripts/demo.sh [ARGUMENT ...]    arguments go to torchfra compare"; exit ;;
  esac
done
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh" cli,compiler
mapfile -t files < <(python -c 'from torchfra.readers import samples; print(*samples("calibration", "gliders"), sep="\n")')
torchfra compare "${files[@]}" --json out/recorded.json --figure out/recorded.png "$@"
