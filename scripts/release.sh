#!/usr/bin/env bash
# A release: builds wheel and source archive into out/dist, checks both in an environment of their own, and sets the tag.
# Nothing is uploaded.
set -euo pipefail
dry=
for argument; do
  case $argument in
    -h | --help) echo "usage: bash scripts/release.sh [--dry-run]    --dry-run: all but the tag"; exit ;;
    --dry-run) dry=1 ;;
    *) echo "release: expected --dry-run or nothing, received $argument" >&2; exit 2 ;;
  esac
done
cd "$(dirname "${BASH_SOURCE[0]}")/.."
version=$(sed -n 's/^__version__ = "\(.*\)"$/\1/p' torchfra/version.py)
refuse() { echo "release: $*" >&2; exit 1; }
[ -z "$(git status --porcelain)" ] || refuse "expected a clean tree; git status tells what is not committed"
grep -qF "## [$version]" CHANGELOG.md || refuse "CHANGELOG.md: expected a heading [$version], there is none"
grep -qx "version: $version" CITATION.cff || refuse "CITATION.cff: expected version $version"
git rev-parse -q --verify "refs/tags/v$version" > /dev/null && refuse "there is a tag v$version already"

source scripts/setup.sh release
rm -rf out/dist
python -m build --quiet --outdir out/dist
twine check --strict out/dist/*

# As a user has it: the wheel alone, in an environment and a folder that know nothing of this clone.
fresh=$(mktemp -d)
trap 'rm -rf "$fresh"' EXIT
here=$PWD
python -m venv "$fresh/venv"
"$fresh/venv/bin/python" -m pip install --quiet --disable-pip-version-check -c constraints.txt out/dist/*.whl
tar -xzf out/dist/*.tar.gz -C "$fresh"
cd "$fresh"
unset PYTHONPATH
venv/bin/python -W error - "$here/README.md" << 'PYTHON'
import re, sys
import torchfra

text = open(sys.argv[1], encoding="utf-8").read()
assert "site-packages" in torchfra.__file__, torchfra.__file__
for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
    exec(block, globals())
PYTHON
venv/bin/torchfra --help > /dev/null
for part in README.md LICENSE CHANGELOG.md CITATION.cff constraints.txt train/README.md scripts/test.sh tests/conftest.py; do
  [ -f "torchfra-$version/$part" ] || refuse "the source archive lacks $part"
done
cd "$here"

if [ -n "$dry" ]; then
  echo "torchfra $version is ready in out/dist; no tag was set"
else
  git tag -a "v$version" -m "torchfra $version"
  echo "torchfra $version is ready in out/dist and has the tag v$version"
fi
