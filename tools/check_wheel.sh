#!/usr/bin/env bash
# tools/check_wheel.sh WHEEL FOLDER: a virtual environment in FOLDER of the wheel and what it asks for; there, from an empty folder and
# without the repository, e2rl lists its commands, evaluates a scene and makes the report.
set -euo pipefail
wheel=$(realpath "$1")
constraints=$(realpath "$(dirname "$0")/../constraints.txt")
environment=$(realpath -m "$2")
python3 -m venv "$environment"
"$environment/bin/pip" install -q "$wheel" -c "$constraints"
empty=$(mktemp -d)
trap 'rm -rf "$empty"' EXIT
cd "$empty"
unset PYTHONPATH
export PATH=$environment/bin:$PATH XDG_CACHE_HOME=$empty/cache
e2rl --help > help
e2rl evaluate num_scenes=1 tries=1 'seeds=[0]' data.build.steps=20 processes=1 report=false hydra.run.dir=run
e2rl report run
[ -s run/failures.html ]
