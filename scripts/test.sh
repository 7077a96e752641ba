#!/usr/bin/env bash
# Static checks and the tests, those with real namespaces included.
#
#   sudo scripts/test.sh                           all but those marked soak; what CI runs
#   sudo scripts/test.sh --soak                    those marked soak: long ones, of which shorter tests cover most
#   scripts/test.sh -k certificate                 arguments go to pytest
#
# Without root the namespace tests run in a user namespace; where that is not allowed they are skipped with that reason.
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
scripts/setup.sh --quiet --dev
scripts/check.sh
if [[ $(id -u) -ne 0 ]]; then
    # Root of a user namespace would share pytest's folder with the machine's root; pytest refuses that.
    PYTEST_DEBUG_TEMPROOT=$(mktemp -d)
    export PYTEST_DEBUG_TEMPROOT
fi
scratch=$(mktemp -d)
trap 'rm -rf "$scratch" ${PYTEST_DEBUG_TEMPROOT:+"$PYTEST_DEBUG_TEMPROOT"}' EXIT

# run <argument>...: pytest, as root of a user namespace where we are not root and that is allowed
run() {
    if [[ $(id -u) -ne 0 ]] && scripts/privileged.sh --check; then
        scripts/privileged.sh .venv/bin/python -m pytest "$@"
    else
        .venv/bin/python -m pytest "$@"
    fi
}

if [[ ${1:-} == --soak ]]; then
    GDP_RANDOM_NETWORKS=8 GDP_RANDOM_LINKS=4 GDP_INSIDERS=3 \
        run tests/journeys/test_random_{networks,links}.py tests/insiders/test_insiders.py "${@:2}" || status=1
    run -m soak "${@:2}" || status=1
    exit "${status:-0}"
fi
if [[ $# -gt 0 ]]; then
    run "$@"
    exit
fi
# Tests with namespaces mostly wait for processes, so two lanes of equal length run in parallel. A failed test runs once
# more alone, to distinguish an unsteady test from a broken one. Both fail the run, unless tests/quarantine.yaml lists the test.
declare -A lanes=(["logic"]="tests" ["spaces"]="netns_tests")
# lane <name> <report> <argument>...: runs the tests of a lane and writes a JUnit file
# shellcheck disable=SC2086  # words
lane() { run -m "not soak" -o "cache_dir=.pytest_cache/$1" --junit-xml "$scratch/$1.$2.xml" ${lanes[$1]} "${@:3}"; }
lane logic first >"$scratch/logic.log" 2>&1 &
others=$!
trap 'kill "$others" 2>/dev/null || true; exit 130' INT TERM
failed=()
declare -A ended=()
lane spaces first || { ended[spaces]=$?; failed+=(spaces); }
wait "$others" || { ended[logic]=$?; failed+=(logic); }
cat "$scratch/logic.log"
status=0
for which in "${failed[@]}"; do
    if [[ ${ended[$which]} -ne 1 ]]; then
        printf 'pytest did not finish (exit status %d): %s\n' "${ended[$which]}" "$which"
        status=1
        continue
    fi
    printf 'failed tests run once more alone: %s\n' "$which"
    lane "$which" rerun --last-failed --last-failed-no-failures none || true  # rerun_check.py reads the outcome
    .venv/bin/python scripts/rerun_check.py --first "$scratch/$which.first.xml" --rerun "$scratch/$which.rerun.xml" || status=1
done
exit "$status"
