#!/usr/bin/env bash
# `import jsonschema` takes 14 times as long where rfc3987-syntax is installed, though no format is checked.
#
# rfc3987-syntax, which jsonschema's extra `format-nongpl` brings and notebook servers depend on, reads a grammar with
# lark and builds its parser as it is imported, and jsonschema imports it at once if it is there. Whatever imports
# jsonschema to check a small document pays for it at each start: ray does, and so does TorchRL where ray is installed.
# Exits 0 as long as the import with it takes more than 3 times as long, least of five, and loads lark.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q jsonschema==4.26.0
cat > "$folder/measure.py" <<'PYTHON'
import subprocess
import sys

code = """
import sys, time
start = time.perf_counter()
import jsonschema
print(time.perf_counter() - start, 'lark' in sys.modules)
"""
runs = []
for _ in range(6):  # the first writes the compiled modules
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    runs.append(run.stdout.split())
print(min(float(seconds) for seconds, _ in runs[1:]), runs[0][1])
PYTHON
read -r without lark_without < <("$folder/venv/bin/python" "$folder/measure.py")
"$folder/venv/bin/pip" install -q rfc3987-syntax==1.1.0
read -r with lark_with < <("$folder/venv/bin/python" "$folder/measure.py")
echo "jsonschema 4.26.0: import takes $without s, lark loaded: $lark_without; with rfc3987-syntax 1.1.0 $with s, $lark_with"
[ "$lark_without" = False ] && [ "$lark_with" = True ]
python3 -c "import sys; sys.exit(not $with > 3 * $without)"
