"""Plugin of all tests; fixtures are in the folders' own files."""

pytest_plugins = ["tests.pool"]
