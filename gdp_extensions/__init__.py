"""Extensions of the core, one a folder; the core finds each through an entry point (docs/reference/extensions.md)."""
