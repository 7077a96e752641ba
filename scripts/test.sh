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
# Tests with namespaces mostly wait for processes, so two lanes run side by side, equally long. Timers of nodes that
# share two cores with other tests may starve: what failed runs once more with nothing beside it, and is told.
clusters=(netns_tests/test_{bench_replicas,experiments,fog,fog_demo,leaving,local_provider,replica_gateway}.py)
declare -A lanes=(["clusters"]="tests ${clusters[*]}" ["spaces"]="netns_tests ${clusters[*]/#/--ignore=}")
# shellcheck disable=SC2086  # words
lane() { run -o "cache_dir=.pytest_cache/$1" ${lanes[$1]} "${@:2}"; }
lane clusters >"$beside" 2>&1 &
others=$!
trap 'kill "$others" 2>/dev/null || true; exit 130' INT TERM
failed=()
declare -A ended=()
lane spaces || { ended[spaces]=$?; failed+=(spaces); }
wait "$others" || { ended[clusters]=$?; failed+=(clusters); }
cat "$beside"
for which in "${failed[@]}"; do
    printf 'failed beside other tests, so once more alone: %s\n' "$which"
    if [[ ${ended[$which]} -eq 1 ]]; then
        lane "$which" --last-failed --last-failed-no-failures none
    else
        lane "$which"  # pytest itself did not come to its end
    fi
    printf 'passed alone: unsteady, look at the failures above\n'
done
