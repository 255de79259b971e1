#!/usr/bin/env bash
# Measure speed and the main rows of Table I on one GPU, within a time limit (docs/speed.md, "On a GPU").
#   benchmarks/gpu.sh --minutes 25                                   # results in runs/gpu; the same command continues
#   benchmarks/gpu.sh --minutes 9 --out "$OUT" --resume .gpu         # on another machine, with what an earlier call wrote
# WHEELS=FOLDER installs the wheels in FOLDER first, for a machine without a package index. PYTHON: default python3.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
if [ -n "${WHEELS:-}" ]; then
  site=$(mktemp -d)
  "$python" -m pip install --quiet --no-index --no-deps --no-compile --target "$site" "$WHEELS"/*.whl
fi
export PYTHONPATH="$PWD/src:$PWD${site:+:$site}${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
exec "$python" -m benchmarks.gpu "$@"
