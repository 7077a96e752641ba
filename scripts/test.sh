#!/usr/bin/env bash
# Everything that must hold: style, types, floors, and all tests, those with real namespaces included.
#
#   sudo scripts/test.sh
#   scripts/test.sh -k certificate                 arguments go to pytest
#
# Without root the namespace tests run in a user namespace; where that is not allowed they are skipped, and say so.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
scripts/setup.sh --dev
scripts/check.sh
if [[ $(id -u) -eq 0 ]]; then
    exec .venv/bin/python -m pytest "$@"
fi
# Root of a user namespace would share pytest's folder with the machine's root, and be refused.
PYTEST_DEBUG_TEMPROOT=$(mktemp -d)
export PYTEST_DEBUG_TEMPROOT
trap 'rm -rf "$PYTEST_DEBUG_TEMPROOT"' EXIT
if scripts/privileged.sh --check; then
    scripts/privileged.sh .venv/bin/python -m pytest "$@"
else
    .venv/bin/python -m pytest "$@"
fi
