# Sourced by the other scripts: makes .venv once, installs the package with the extras named in $1, and activates it.
# Reinstalls only when what it would install has changed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
extras=$1
stamp=.venv/installed-$extras
if [ ! -x .venv/bin/python ]; then
  python=${PYTHON:-python3}
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { echo "torchfra needs Python 3.10 or newer" >&2; exit 2; }
  "$python" -m venv .venv
fi
if ! cat pyproject.toml constraints.txt | cmp -s - "$stamp"; then
  echo "installing torchfra[$extras] into .venv"
  .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt "torch==$(sed -n 's/^torch==//p' constraints.txt)"
  .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e ".[$extras]"
  # Recorded tracks.  Only its files are read: its own dependencies are not needed.
  .venv/bin/python -m pip install --quiet --no-compile --disable-pip-version-check --no-deps traffic==2.13
  cat pyproject.toml constraints.txt > "$stamp"
fi
export PATH="$PWD/.venv/bin:$PATH"
# Python keeps modules that it has compiled: each process that had to compile those of torch again would take two seconds more.
unset PYTHONDONTWRITEBYTECODE
