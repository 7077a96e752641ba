#!/usr/bin/env bash
# What can be said about the source without running it: style, types, and that no room imports upwards.
set -euo pipefail

cd "$(dirname "${BASH_SOURCE[0]}")/.."
.venv/bin/ruff check .
.venv/bin/ruff format --check --quiet --exclude "*.md" .
.venv/bin/mypy
.venv/bin/lint-imports
