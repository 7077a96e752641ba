#!/usr/bin/env bash
# Builds the site of docs/ into build/site; broken links and anchors are errors.
#
#   scripts/docs.sh           build, and print where the first page is
#   scripts/docs.sh --serve   build, and serve on http://127.0.0.1:8000 until Ctrl-C
#
# MkDocs comes from .venv where it has the extra `docs`; otherwise this script makes build/docs-venv with that extra alone.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=.venv/bin/python
if ! "$python" -c 'import material, mkdocs, mkdocstrings' 2>/dev/null; then
    python=build/docs-venv/bin/python
    if ! "$python" -c 'import material, mkdocs, mkdocstrings' 2>/dev/null; then
        mapfile -t packages < <(sed -nE '/^docs = \[$/,/^\]$/s/^ *"(.*)",?$/\1/p' pyproject.toml)
        printf 'docs: installing %s into build/docs-venv\n' "${packages[*]}" >&2
        python3 -m venv build/docs-venv
        "$python" -m pip install --quiet --disable-pip-version-check "${packages[@]}"
    fi
fi
export NO_MKDOCS_2_WARNING=1
case "${1:-}" in
    --serve) exec "$python" -m mkdocs serve ;;
    "") ;;
    *)
        printf 'docs: unknown option %s (use --serve, or none)\n' "$1" >&2
        exit 2
        ;;
esac
"$python" -m mkdocs build --strict
printf 'docs: build/site/index.html\n'
