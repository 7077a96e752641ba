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
if [[ $(id -u) -ne 0 ]]; then
    # Root of a user namespace would share pytest's folder with the machine's root, and be refused.
    PYTEST_DEBUG_TEMPROOT=$(mktemp -d)
    export PYTEST_DEBUG_TEMPROOT
fi
beside=$(mktemp)
trap 'rm -rf "$beside" ${PYTEST_DEBUG_TEMPROOT:+"$PYTEST_DEBUG_TEMPROOT"}' EXIT

# run <argument>...: pytest, as root of a user namespace where we are not root and that is allowed
run() {
    if [[ $(id -u) -ne 0 ]] && scripts/privileged.sh --check; then
        scripts/privileged.sh .venv/bin/python -m pytest "$@"
    else
        .venv/bin/python -m pytest "$@"
    fi
}

if [[ $# -gt 0 ]]; then
    run "$@"
    exit
fi
# Tests with namespaces mostly wait for processes; what runs in one process alone runs beside them. Timers of nodes that
# share two cores with other tests may starve: what failed runs once more with nothing beside it, and is told.
lane() { run -o "cache_dir=.pytest_cache/$1" "${@:2}"; }
lane beside tests >"$beside" 2>&1 &
others=$!
trap 'kill "$others" 2>/dev/null || true; exit 130' INT TERM
failed=()
lane spaces netns_tests || failed+=("spaces netns_tests")
wait "$others" || failed+=("beside tests")
cat "$beside"
for which in "${failed[@]}"; do
    printf 'failed beside other tests, so once more alone: %s\n' "${which#* }"
    # shellcheck disable=SC2086  # two words
    lane $which --last-failed --last-failed-no-failures none
    printf 'passed alone: unsteady, look at the failures above\n'
done
