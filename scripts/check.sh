#!/usr/bin/env bash
# Static checks: style, types, import rules, and readability figures that never get worse.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
.venv/bin/ruff check .
.venv/bin/ruff format --check --quiet --exclude "*.md" .
# Clones share mypy's cache, which knows a file by its content: 7 processor seconds in place of 70.
MYPY_CACHE_DIR=${MYPY_CACHE_DIR:-${GDP_TEST_CACHE:-$HOME/.cache/gdp-ros}/mypy} .venv/bin/mypy
.venv/bin/lint-imports
scripts/lock.sh --check
.venv/bin/python scripts/readability.py --check
.venv/bin/python scripts/bench/page_age.py --warn
