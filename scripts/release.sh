#!/usr/bin/env bash
# A release: builds wheel and source archive into out/dist, checks both in an environment of their own, and sets the tag.
# Nothing is uploaded.  Before it, --prepare VERSION gives the files that version, to be looked at and committed.
set -euo pipefail
dry= next= packages=
case "$#,${1-}" in
  0,) ;;
  1,-h | 1,--help)
    echo "usage: bash scripts/release.sh [--packages | --dry-run | --prepare VERSION]"
    echo "--packages: builds and checks alone, of any commit; --dry-run: all but the tag; --prepare: names the version where it is written, and what is unreleased by it"
    exit ;;
  1,--packages) dry=1 packages=1 ;;
  1,--dry-run) dry=1 ;;
  2,--prepare) next=$2 ;;
  *) echo "release: expected --packages, --dry-run, --prepare VERSION or nothing, received $*" >&2; exit 2 ;;
esac
cd "$(dirname "${BASH_SOURCE[0]}")/.."
version=$(sed -n 's/^__version__ = "\(.*\)"$/\1/p' torchfra/version.py)
refuse() { echo "release: $*" >&2; exit 1; }
replace() { sed "$1" "$2" > "$2.part" && mv "$2.part" "$2"; }
[ -z "$(git status --porcelain)" ] || refuse "expected a clean tree; git status tells what is not committed"

if [ -n "$next" ]; then
  [[ $next =~ ^[0-9]+\.[0-9]+\.[0-9]+$ ]] || refuse "--prepare: expected a version such as 1.2.0, received $next"
  ! grep -qF "## [$next]" CHANGELOG.md || refuse "CHANGELOG.md: there is a heading [$next] already"
  news=$(sed -n '/^## \[Unreleased\]$/,/^## \[[0-9]/{/^- /p;}' CHANGELOG.md)
  [ -n "$news" ] || refuse "CHANGELOG.md: expected changes below [Unreleased], there are none"
  replace "s/^## \\[Unreleased\\]$/&\\
\\
## [$next] - $(date -u +%F)/" CHANGELOG.md
  replace "s/^version: .*/version: $next/" CITATION.cff
  replace "s/^__version__ = .*/__version__ = \"$next\"/" torchfra/version.py
  echo "torchfra $next: look at CHANGELOG.md, CITATION.cff and torchfra/version.py, commit them, and release without --prepare"
  exit
fi
[ -n "$packages" ] || grep -qF "## [$version]" CHANGELOG.md || refuse "CHANGELOG.md: expected a heading [$version], there is none: --prepare $version"
grep -qx "version: $version" CITATION.cff || refuse "CITATION.cff: expected version $version"
[ -n "$packages" ] || ! git rev-parse -q --verify "refs/tags/v$version" > /dev/null || refuse "there is a tag v$version already"

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
import pathlib, re, sys
import torchfra

text = pathlib.Path(sys.argv[1]).read_text(encoding="utf-8")
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
