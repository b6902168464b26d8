#!/usr/bin/env bash
# tools/release.sh: the source archive and the wheel made of it in dist/, if the sources here make the same wheel and it works in an
# empty environment; the list of what it installs beside it (CycloneDX 1.6), and whether any of that is known to be vulnerable. The
# last asks the package index and its advisories; where these cannot be reached it fails.
set -euo pipefail
cd "$(dirname "$0")/.."
fresh=$(mktemp -d)
trap 'rm -rf "$fresh"' EXIT
contents() {  # WHEEL
    python -c 'import sys, zipfile; [print(f.CRC, f.filename) for f in zipfile.ZipFile(sys.argv[1]).infolist()]' "$1" | sort
}
python -m build
wheel=$(ls -t dist/e2rl-*.whl | head -1)
python -m build --wheel --outdir "$fresh"
diff <(contents "$wheel") <(contents "$fresh"/e2rl-*.whl)
tools/check_wheel.sh "$wheel" "$fresh/venv"
python -m cyclonedx_py environment --pyproject pyproject.toml --mc-type library --output-reproducible \
    --output-file "${wheel%.whl}.cdx.json" "$fresh/venv/bin/python"
echo "$wheel and ${wheel%.whl}.cdx.json"
"$fresh/venv/bin/pip" freeze --exclude e2rl > "$fresh/audited"
python -m pip_audit --strict --progress-spinner off --disable-pip --no-deps -r "$fresh/audited"
