#!/usr/bin/env bash
# tools/versions.sh oldest|newest [arguments of pytest]: the tests with the oldest or the newest torch, torchrl and
# tensordict that pyproject.toml allows, in a fresh environment; the other packages are those of constraints.txt.
set -euo pipefail
cd "$(dirname "$0")/.."
case "${1:-}" in
    oldest) versions=(torch==2.7.0 torchrl==0.14.0 tensordict==0.14.3) ;;
    newest) versions=(torch torchrl tensordict) ;;
    *) sed -n '2,3s/^# //p' "$0" >&2; exit 2 ;;
esac
shift
fresh=$(mktemp -d)
trap 'rm -rf "$fresh"' EXIT
grep -vE '^(torch|torchrl|tensordict)==' constraints.txt > "$fresh/constraints.txt"
python3 -m venv "$fresh/venv"
"$fresh/venv/bin/pip" install -q -e ".[test]" "${versions[@]}" -c "$fresh/constraints.txt"
"$fresh/venv/bin/pip" freeze | grep -E '^(torch|torchrl|tensordict)=='
OMP_NUM_THREADS=1 "$fresh/venv/bin/python" -m pytest "$@"
