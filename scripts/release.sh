#!/usr/bin/env bash
# What a release does: scripts/release.sh 0.2.0
# The version, tests, wheel, source archive and site, and a tag; pushing and uploading are left to who reads the last lines.
set -euo pipefail
cd "$(dirname "$0")/.."
version=${1:?which version? scripts/release.sh 0.2.0}
[[ $version =~ ^[0-9]+\.[0-9]+\.[0-9]+$ ]] || { echo "'$version' is no version: three numbers with points"; exit 2; }
[ -z "$(git status --porcelain)" ] || { echo "commit or remove what git status lists first"; exit 2; }
! git rev-parse --quiet --verify "refs/tags/v$version" > /dev/null || { echo "v$version is there: choose another version"; exit 2; }
grep -q '^## Unreleased$' CHANGELOG.md || { echo "CHANGELOG.md has no '## Unreleased'"; exit 2; }

sed -i "s/^## Unreleased$/## Unreleased\n\n## $version, $(date +%F)/" CHANGELOG.md
sed -i "s/^version = \".*\"$/version = \"$version\"/" pyproject.toml
sed -i "s/^__version__ = \".*\"$/__version__ = \"$version\"/" src/gsx/__init__.py
undo() { git checkout --quiet CHANGELOG.md pyproject.toml src/gsx/__init__.py; echo "nothing was released"; }
trap undo ERR INT TERM

.ci/run
rm -rf dist
.venv/bin/python -m build --no-isolation --outdir dist .
make site
git commit --quiet --all --message "Version $version"
trap - ERR INT TERM
git tag --annotate "v$version" --message "gsx $version"
echo "dist/ and build/site/ are made, v$version is tagged. To publish them:"
echo "  git push --follow-tags && python -m twine upload dist/*, and copy build/site to where it is served"
