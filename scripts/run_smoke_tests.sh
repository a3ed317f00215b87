#!/usr/bin/env bash
# Runs every algorithm, environment, performance test and search for a second or two.
#
#   scripts/run_smoke_tests.sh                  all, in two processes
#   scripts/run_smoke_tests.sh -k cleansac      some, with pytest's options
set -euo pipefail
cd "$(dirname "$0")/.."
PYTHON=.venv/bin/python
[ -x "$PYTHON" ] || PYTHON=python3
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
exec "$PYTHON" -m pytest tests/smoke -m smoke -n "${WORKERS:-2}" --dist worksteal --durations 5 "$@"
