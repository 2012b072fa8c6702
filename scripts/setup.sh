# Sourced by the other scripts: makes .venv once, installs the package with the extras named in $1, such as docs or docs,dev,
# and activates it.  Reinstalls only when what it would install has changed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
extras=$1
stamps=(${extras//,/ })
stamps=("${stamps[@]/#/.venv/installed-}")
if [ ! -x .venv/bin/python ]; then
  python=${PYTHON:-python3}
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { echo "torchfra needs Python 3.10 or newer" >&2; exit 2; }
  "$python" -m venv .venv
fi
missing=
for stamp in "${stamps[@]}"; do cat pyproject.toml constraints.txt | cmp -s - "$stamp" || missing=1; done
if [ -n "$missing" ]; then
  echo "installing torchfra[$extras] into .venv"
  .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt "torch==$(sed -n 's/^torch==//p' constraints.txt)"
  .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e ".[$extras]"
  # Recorded tracks.  Only its files are read: its own dependencies are not needed.
  .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check --no-deps traffic==2.13
  cat pyproject.toml constraints.txt | tee "${stamps[@]}" > /dev/null
fi
export PATH="$PWD/.venv/bin:$PATH"
# Python keeps modules that it has compiled: each process that had to compile those of torch again would take two seconds more.
unset PYTHONDONTWRITEBYTECODE
