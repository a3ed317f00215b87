#!/usr/bin/env bash
# Runs performance tests until each has its answer, and continues where it was interrupted.
#
#   scripts/run_performance_tests.sh                    all tests
#   scripts/run_performance_tests.sh FetchReach --jobs 2
#   scripts/run_performance_tests.sh --tier pr          those of minutes; nightly: hours
#   scripts/run_performance_tests.sh --list
#
# Exit code: 0 all passed, 1 one failed, 2 wrong input, 3 one was undecided or crashed.
# Reports: data/performance/report.{md,html,xml,json}, the .xml as JUnit.
set -euo pipefail
cd "$(dirname "$0")/.."
PYTHON=.venv/bin/python
[ -x "$PYTHON" ] || PYTHON=python3
exec "$PYTHON" src/main.py performance "$@"
