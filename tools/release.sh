#!/usr/bin/env bash
# tools/release.sh: the wheel in dist/, the list of what it installs beside it (CycloneDX 1.6), and whether any of that is
# known to be vulnerable. The last asks the package index and its advisories; where these cannot be reached it fails.
set -euo pipefail
cd "$(dirname "$0")/.."
python -m build --wheel
wheel=$(ls -t dist/e2rl-*.whl | head -1)
fresh=$(mktemp -d)
trap 'rm -rf "$fresh"' EXIT
python -m venv "$fresh"
"$fresh/bin/pip" install -q "$wheel" -c constraints.txt
python -m cyclonedx_py environment --pyproject pyproject.toml --mc-type library --output-reproducible \
    --output-file "${wheel%.whl}.cdx.json" "$fresh/bin/python"
echo "$wheel and ${wheel%.whl}.cdx.json"
"$fresh/bin/pip" freeze --exclude e2rl > "$fresh/audited"
python -m pip_audit --strict --progress-spinner off --disable-pip --no-deps -r "$fresh/audited"
