#!/usr/bin/env bash
# Static checks and the tests, those with real namespaces included.
#
#   sudo scripts/test.sh                           the change lane: what a change must pass; what CI runs
#   sudo scripts/test.sh --nightly                 all tests: real programs, full draws, benches, chaos, models, packages
#   scripts/test.sh -k certificate                 arguments go to pytest
#
# Without root the namespace tests run in a user namespace; where that is not allowed they are skipped with that reason.
# .ci/out/ keeps the seconds of each file and the outcome of each test (JUnit).
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
scripts/setup.sh --quiet --dev
out=.ci/out
# Clones share what Hypothesis reads in the source, by its content.
export HYPOTHESIS_STORAGE_DIRECTORY=${HYPOTHESIS_STORAGE_DIRECTORY:-${GDP_TEST_CACHE:-$HOME/.cache/gdp-ros}/hypothesis}
unset PYTHONDONTWRITEBYTECODE  # workers and the programs that they start share what one of them has compiled
mkdir -p "$out"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch" ${PYTEST_DEBUG_TEMPROOT:+"$PYTEST_DEBUG_TEMPROOT"}' EXIT
if [[ $(id -u) -ne 0 ]]; then
    # Root of a user namespace would share pytest's folder with the machine's root; pytest refuses that.
    PYTEST_DEBUG_TEMPROOT=$(mktemp -d)
    export PYTEST_DEBUG_TEMPROOT
fi

# run <argument>...: pytest, as root of a user namespace where we are not root and that is allowed
run() {
    if [[ $(id -u) -ne 0 ]] && scripts/privileged.sh --check; then
        scripts/privileged.sh .venv/bin/python -m pytest "$@"
    else
        .venv/bin/python -m pytest "$@"
    fi
}

case "${1:-}" in
    "") lane=change selected=(-m "not nightly") judged=(--budgets) ;;
    --nightly)
        export GDP_REAL_PROGRAMS=1 GDP_DRAWS=4
        lane=nightly selected=() judged=()
        shift
        ;;
    *)
        scripts/check.sh
        run "$@"
        exit
        ;;
esac
# The checks compute and many tests wait, so they share the cores; so do the workers, of which there is one more than cores.
scripts/check.sh >"$scratch/check.log" 2>&1 &
checks=$!
trap 'kill "$checks" 2>/dev/null || true; exit 130' INT TERM
ended=0 status=0
run -n "$(($(nproc) + 1))" "${selected[@]}" "${judged[@]}" --seconds "$out/seconds.json" --durations 25 --junit-xml "$out/tests.xml" "$@" ||
    ended=$?
wait "$checks" || status=1
cat "$scratch/check.log"
if [[ $ended -ne 0 ]]; then  # 6: all passed, and a folder took half more than its budget
    printf 'pytest ended with exit status %d\n' "$ended"
    status=1
fi
if [[ $lane == nightly && $(id -u) -eq 0 ]]; then
    printf 'fuzzing: ten minutes of all decoders\n'
    .venv/bin/python scripts/fuzz.py --guided --total 600 || status=1
    printf 'chaos: ten minutes of faults of every kind, two RIBs on a shared store\n'
    # At the usual keepalives, twelve switches alone keep two slow cores busy; what is silent then says nothing of faults.
    .venv/bin/python scripts/bench/chaos.py --seed 9 --seconds 600 --switches 12 --rate 0.25 --keepalive-ms 200 --limit-s 8 ||
        status=1
fi
exit "$status"
