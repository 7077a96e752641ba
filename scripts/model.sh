#!/usr/bin/env bash
# Proves the models of docs/model with ProVerif and compares each result with the table of docs/model/README.md.
#
#   scripts/model.sh            run all, about 5 s
#   scripts/model.sh --write    the same; then record the files of the results (docs/model/SHA256SUMS)
#
# PROVERIF names the program if it is not on the path. Exit: 0 all as in the table, 1 another result, 3 no ProVerif.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/../docs/model"
export LC_ALL=C

proverif=${PROVERIF:-proverif}
if ! command -v "$proverif" >/dev/null; then
    printf 'model: ProVerif is not here (https://proverif.inria.fr, or "opam install proverif")\n' >&2
    exit 3
fi

# prove <run>: prints "<run> <result>" for each query, in order. A run is a model, or model:echo for one with two echoes.
prove() {
    local model=${1%%:*} echo=() out
    [[ $1 == *:* ]] && echo=(-lib "echo_${1##*:}")
    out=$(timeout 100 "$proverif" -lib common "${echo[@]}" "$model.pv") || { printf '%s\n' "$out" >&2; return 1; }
    sed -n -e 's/^RESULT not event.* is false\.$/reachable/p' -e 's/^RESULT not (event.* is false\.$/reachable/p' \
        -e '/^RESULT not (*event/!s/^RESULT .* is true\.$/proven/p' \
        -e '/^RESULT not (*event/!s/^RESULT .* is false\.$/attack/p' \
        -e 's/^RESULT .* cannot be proved\.$/unknown/p' <<<"$out" | sed "s/^/$1 /"
}

# The table: | `run` | id | what | result |
stated=$(sed -nE 's/^\| `([a-z:]+)` \| [A-Z0-9]+ \| .* \| (proven|attack|reachable) \|$/\1 \2/p' README.md)
found=""
for run in $(printf '%s\n' "$stated" | cut -d' ' -f1 | uniq); do
    begun=$(date +%s%N)
    results=$(prove "$run") || exit 1
    printf '%-14s %d queries, %d ms\n' "$run" "$(wc -l <<<"$results")" $((($(date +%s%N) - begun) / 1000000))
    found+=$results$'\n'
done
if ! diff <(printf '%s\n' "$stated") <(printf '%s' "$found"); then
    printf 'model: another result than docs/model/README.md states (<: stated, >: found)\n' >&2
    exit 1
fi
if [[ ${1:-} == --write ]]; then
    sha256sum -- *.pv *.pvl >SHA256SUMS
fi
printf '%d results are as stated\n' "$(wc -l <<<"$stated")"
