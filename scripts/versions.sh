#!/usr/bin/env bash
# Tries the package under other Pythons and torches that this machine and its registry have: for each an environment of
# its own in a temporary folder, the wheel, and the tests that say most per second.  What cannot be had is said, and is
# no failure.
set -euo pipefail
tried=(3.10:2.4.1 3.12:2.7.1 3.13:2.13.0 3.11:newest)
# What hangs on Python and torch, and says most per second: imports, square roots, beliefs, models, filters, compiled ones.
# Readers but for times, of which each Python reads other forms, cleaning, commands, scripts, training, figures and documents
# are tested once, by test.sh.
tests=(
  import presets hessian tria mixture states camera composed_sensors oracles failures autocast predict smoothing
  ready_tracks jpda_gates jpda_promises times
)
gigabytes=8 # of one environment, with what is unpacked on the way
patience=180 # seconds for one, of which it takes twenty where the registry is quick; who is slow once is not asked again

chosen=() how=(-n auto --dist worksteal)
for argument; do
  case $argument in
    -h | --help)
      echo "usage: bash scripts/versions.sh [--quick] [PYTHON:TORCH ...]"
      echo "Tries the package under other Pythons and torches that this machine and its registry have,"
      echo "such as 3.12:2.7.1 or 3.11:newest; without arguments ${tried[*]}.  --quick leaves out slow tests."
      echo "An environment takes $gigabytes GB in TMPDIR as long as it is tried.  Settings of uv, such as UV_INDEX_URL, hold."
      exit
      ;;
    --quick) how=(-m "not slow") ;; # in one process, as others are at work: each process more imports torch once more
    [0-9]*.[0-9]*:newest | [0-9]*.[0-9]*:[0-9]*.[0-9]*) chosen+=("$argument") ;;
    *) echo "versions: expected PYTHON:TORCH such as 3.12:2.7.1 or 3.11:newest, received $argument" >&2; exit 2 ;;
  esac
done
[ ${#chosen[@]} = 0 ] || tried=("${chosen[@]}")
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset PYTHONPATH VIRTUAL_ENV PYTHONDONTWRITEBYTECODE # setup.sh says why the last
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export UV_CACHE_DIR=$work/cache UV_PYTHON_DOWNLOADS=never UV_HTTP_TIMEOUT=${UV_HTTP_TIMEOUT:-30}
said=() failed=0 slow=

# The interpreter of a version, on the path or of pyenv; nothing if there is none.
interpreter() {
  local path
  for path in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python; do
    [ "$("$path" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2> /dev/null)" = "$1" ] && { echo "$path"; return; }
  done
  return 0
}

# Installs uv where there is none, and makes the wheel and what the tests need beside it.
prepare() {
  PATH=$PATH:$work/tools/bin
  if ! command -v uv > /dev/null; then
    python3 -m venv "$work/tools"
    timeout 120 "$work/tools/bin/python" -m pip install --quiet --disable-pip-version-check --retries 1 --timeout 20 uv || return
  fi
  # Of a copy: a build writes into its folder, and so may an installation of it beside this one.
  mkdir "$work/source" "$work/tree" && tar -c --anchored --exclude=out .github [!.]* | tar -x -C "$work/source" || return
  timeout 120 uv build --quiet --out-dir "$work/dist" "$work/source" || return
  tar -xzf "$work"/dist/*.tar.gz -C "$work/tree" --strip-components 1 || return
  rm -r "$work/tree/torchfra" # as a user has it: the wheel alone
  grep -v '^torch==' constraints.txt > "$work/constraints.txt"
}

# Makes $work/venv with a Python and a torch; says why not.
install() {
  local python torch=torch
  python=$(interpreter "$1")
  [ -n "$python" ] || { echo "there is no Python $1"; return 1; }
  [ "$2" = newest ] || torch="torch==$2"
  [ "$(df -Pk "$work" | awk 'END {print int($4 / 2^20)}')" -ge $gigabytes ] || { echo "less than $gigabytes GB are free"; return 1; }
  uv venv --quiet --python "$python" "$work/venv" 2>&1 || return
  timeout $patience uv pip install --quiet --python "$work/venv/bin/python" -c "$work/constraints.txt" "$torch" \
    "torchfra[dev] @ file://$(echo "$work"/dist/*.whl)" > "$work/log" 2>&1 && return
  [ $? != 124 ] || { echo "the registry takes longer than $patience s"; return 124; }
  echo "the registry does not give it ($(tr -s '\n ' ' ' < "$work/log" | cut -c 1-200))"
  return 1
}

# Tries one; says what came of it.
try() {
  local python=${1%:*} torch=${1#*:} why=$slow status=0 begin=$SECONDS installed files
  [ -n "$slow" ] || why=$(install "$python" "$torch") || status=$?
  [ $status != 124 ] || slow=$why
  if [ -n "$slow" ] || [ $status != 0 ]; then
    said+=("Python $python, torch $torch: not to be had: $why")
    return
  fi
  installed=$((SECONDS - begin))
  torch=$("$work/venv/bin/python" -c 'import torch; print(torch.__version__)') || torch="$torch, which cannot be imported"
  echo "Python $python, torch $torch: installed in $installed s"
  files=("${tests[@]/#/tests/*/test_}")
  (
    cd "$work/tree"
    OMP_NUM_THREADS=1 timeout 600 "$work/venv/bin/python" -m pytest -p no:cacheprovider \
      "${how[@]}" ${files[@]/%/.py}
  ) || status=$?
  if [ $status = 0 ]; then why=passed; else why="failed (pytest: $status)" failed=1; fi
  said+=("Python $python, torch $torch: $why, $((SECONDS - begin)) s")
}

if prepare > "$work/log" 2>&1; then
  for one in "${tried[@]}"; do
    try "$one"
    rm -rf "$work/venv" "$work/cache"
  done
else
  said+=("nothing was tried: the registry does not give uv or setuptools ($(tr -s '\n ' ' ' < "$work/log" | cut -c 1-200))")
fi
printf '%s\n' "${said[@]}"
exit $failed
